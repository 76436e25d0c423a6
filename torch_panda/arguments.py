"""Arguments: classes by name, errors that list the accepted names, and reprs."""

import dataclasses
import difflib
import functools
import inspect
from collections.abc import Collection, Iterable, Mapping
from importlib import import_module
from typing import Any, ClassVar, NamedTuple

from typing_extensions import Self


class Configured:
    """Base of classes whose objects are configured by keyword arguments.

    An unknown argument raises a `TypeError` that lists the accepted ones. The ``repr``
    of an object shows its arguments. It finds the value of an argument ``x`` in the
    attribute ``x`` or ``_x``.

    An environment calls `freeze` on its robot and its task when it was built. From then
    on an assignment either has an effect or raises an `AttributeError`:

    * An argument in `changeable` may change. `check_arguments` checks the new value.
    * Other arguments, methods, and attributes that the base class declares are fixed.
    * State of a subclass stays assignable: attributes that the object or its class
      already had, and names that begin with an underscore.
    * Any other name is unknown.

    Copies of a frozen object, also those in other processes, are not frozen.
    """

    changeable: ClassVar[tuple[str, ...]] = ()
    """Arguments that may change in an environment, in addition to the base classes'."""
    _replaceable_methods: ClassVar[frozenset[str]] = frozenset()
    # The fixes for assignments, by unknown name.
    _assignment_advice: ClassVar[Mapping[str, str]] = {}
    _is_frozen = False

    def __new__(cls, *args: object, **arguments: object) -> Self:
        """Refuse unknown arguments, and defaults that have no effect."""
        # A constructor with ``**options`` passes them on, so Python checks these.
        if not _has_options(inspect.signature(cls.__init__).parameters):
            accepted = argument_names(cls)
            check_names(cls.__name__, arguments, accepted)
        _check_defaults(cls)
        return super().__new__(cls)

    def __getstate__(self) -> dict[str, Any]:
        """The attributes of a copy or a pickle, which is not frozen."""
        return {name: x for name, x in vars(self).items() if name != "_is_frozen"}

    def __setattr__(self, name: str, value: object) -> None:
        """Refuse assignments without effect; see the class."""
        if name.startswith("_"):
            super().__setattr__(name, value)
            return
        self._check_assignment(name)
        is_change = self._is_frozen and name in self._configured_names.changeable
        before = getattr(self, name) if is_change else None
        super().__setattr__(name, value)
        if is_change:
            try:
                self.check_arguments()
            except BaseException:
                super().__setattr__(name, before)
                raise

    def freeze(self) -> None:
        """Refuse further assignments that would have no effect.

        Raises:
            ValueError: An argument was changed to a value that is out of range.
        """
        self.check_arguments()
        self._is_frozen = True

    def check_arguments(self) -> None:
        """Check the arguments.

        The constructor calls this method, and so does each change of an argument in
        `changeable`.

        Raises:
            ValueError: An argument is out of range.
            TypeError: An argument has a wrong type.
        """

    @property
    def _configured_names(self) -> "_Names":
        return _names_of(type(self))  # type: ignore[arg-type]  # a class is hashable

    def _check_assignment(self, name: str) -> None:
        """Refuse an assignment that would have no effect; see `Configured`."""
        names, owner = self._configured_names, type(self).__name__
        is_method = callable(getattr(type(self), name, None))
        if name in names.declared and is_method:
            if self._is_frozen or name not in self._replaceable_methods:
                raise AttributeError(
                    f"{name} cannot be replaced in an object, because it is a method: "
                    f"override it in a subclass of {owner}"
                )
            return
        if not self._is_frozen or name in names.changeable:
            return
        if name in names.arguments | names.declared:
            raise AttributeError(
                f"{name} cannot be changed in the {owner} of an environment: make a "
                f"new {owner} and a new environment; arguments that can change are "
                f"{', '.join(names.changeable) or 'none'} (a subclass can add names to "
                f"its attribute changeable)"
            )
        if name in vars(self) or (hasattr(type(self), name) and not is_method):
            return
        options = argument_names(type(self))
        hint = suggest(name, options)
        if name in self._assignment_advice:
            hint = f"{self._assignment_advice[name]}; "
        raise AttributeError(
            f"{owner} has no option {name!r}; {hint}options are {', '.join(options)}; "
            f"state of your own needs an attribute of the class, such as {name} = "
            f"None, or a name that begins with an underscore"
        )

    def __repr__(self) -> str:
        shown = [
            f"{name}={vars(self)[attribute]!r}"
            for name in argument_names(type(self))
            for attribute in (name, f"_{name}")
            if attribute in vars(self)
        ]
        return f"{type(self).__name__}({', '.join(shown)})"


class _Names(NamedTuple):
    """Names of attributes of a subclass of `Configured`.

    Attributes:
        arguments: Arguments of the class and of all its base classes.
        changeable: Arguments that may change in an environment.
        declared: Attributes that the direct subclass of `Configured` declares, for
            example the methods of `Task`.
    """

    arguments: frozenset[str]
    changeable: tuple[str, ...]
    declared: frozenset[str]


@functools.cache  # user code may assign attributes at every step
def _names_of(owner: type[Any]) -> _Names:
    arguments: set[str] = set()
    changeable: dict[str, None] = {}  # an ordered set
    declared: set[str] = set()
    for base in reversed(owner.__mro__):
        changeable |= dict.fromkeys(vars(base).get("changeable", ()))
        if Configured in base.__bases__:
            declared = {*dir(base), *inspect.get_annotations(base)}
        if issubclass(base, Configured) and "__init__" in vars(base):
            arguments.update(_own_arguments(base))
    return _Names(frozenset(arguments), tuple(changeable), frozenset(declared))


def _check_defaults(owner: type[Any]) -> None:
    """Refuse a class that sets an argument of a dataclass without being one.

    The constructor would replace the value by the default of the base class.
    """
    if not dataclasses.is_dataclass(owner):
        return
    types = {field.name: field.type for field in dataclasses.fields(owner)}
    for base in owner.__mro__:
        if "__init__" in vars(base):
            return
        for name in vars(base).keys() & types.keys():
            type_name = getattr(types[name], "__name__", types[name])
            raise TypeError(
                f"{base.__name__}.{name} has no effect, because the constructor sets "
                f"{name} to the default of the base class: write @dataclass("
                f"kw_only=True) above the class, and a type behind the name, such as "
                f"{name}: {type_name} = {vars(base)[name]!r}"
            )


def load_class(package: str, path: str) -> Any:  # noqa: ANN401 (any class)
    """Import a class of a package, given as ``module:Class``."""
    module, name = path.split(":")
    return getattr(import_module(f"{package}.{module}"), name)


def suggest(name: str, accepted: Collection[str]) -> str:
    """The question "did you mean ...?" for an error; empty if no name is similar."""
    similar = difflib.get_close_matches(name, accepted, n=1)
    return f"did you mean {similar[0]!r}? " if similar else ""


def check_names(
    owner: str,
    names: Iterable[str],
    accepted: Collection[str],
    advice: Mapping[str, str] | None = None,
) -> None:
    """Refuse names of arguments that are not accepted.

    Args:
        owner: Name of the function, for the error.
        names: Names of the arguments in the call.
        accepted: Names of the arguments that the function has.
        advice: The fix for some names that the function does not have.

    Raises:
        TypeError: A name is not accepted.
    """
    for name in names:
        if name in accepted:
            continue
        hint = suggest(name, accepted)
        if advice and name in advice:
            hint = f"{advice[name]}; "
        # The wording is Python's own, because torchrl's GymEnv looks for it and then
        # tries again without the argument `frameskip`.
        raise TypeError(
            f"{owner} got an unexpected keyword argument {name!r}; {hint}"
            f"accepted are {', '.join(accepted) or 'none'}"
        )


def argument_names(owner: type) -> list[str]:
    """Names of the arguments of a class.

    A class with ``**options`` passes them to its base class, whose names are included.
    """
    names: list[str] = []
    for base in owner.__mro__:
        if "__init__" in vars(base):
            names += [name for name in _own_arguments(base) if name not in names]
            if not _has_options(inspect.signature(vars(base)["__init__"]).parameters):
                break
    return names


def check_no_option(name: str, path: str, **parts: Configured) -> None:
    """Refuse to set an option of a part on the environment, where it has no effect.

    Args:
        name: Name of the attribute to set.
        path: Expression for the environment that has the parts, for the error.
        **parts: Parts of the environment, by name.

    Raises:
        AttributeError: The attribute is an option of a part.
    """
    for part, owner in parts.items():
        if name in argument_names(type(owner)):
            raise AttributeError(
                f"{name} is an option of the {part}, not of the environment: see "
                f"{path}.{part}.{name}"
            )


def _own_arguments(owner: type) -> list[str]:
    """Names of the arguments of the ``__init__`` that a class itself defines."""
    parameters = inspect.signature(vars(owner)["__init__"]).parameters
    variadic = inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD
    return [name for name, p in parameters.items() if p.kind not in variadic][1:]


def _has_options(parameters: Mapping[str, inspect.Parameter]) -> bool:
    return any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters.values())
