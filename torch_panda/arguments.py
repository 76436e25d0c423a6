"""Arguments: classes by name, errors that list the accepted names, and reprs."""

import difflib
import inspect
from collections.abc import Callable, Collection, Iterable, Mapping
from importlib import import_module
from types import FunctionType
from typing import Any

from typing_extensions import Self


class Configured:
    """Base of classes whose objects are configured by keyword arguments.

    An unknown argument raises a `TypeError` that lists the accepted ones. The ``repr``
    of an object shows its arguments. It finds the value of an argument ``x`` in the
    attribute ``x`` or ``_x``.
    """

    _fixed: frozenset[str] = frozenset()

    def __new__(cls, *args: object, **arguments: object) -> Self:
        """Refuse unknown arguments."""
        if arguments:
            check_call(cls.__name__, cls, arguments)
        return super().__new__(cls)

    def __setattr__(self, name: str, value: object) -> None:
        """Refuse to change attributes that `fix` named."""
        if name in self._fixed:
            raise AttributeError(
                f"{name} cannot be changed in a {type(self).__name__} of an "
                f"environment, because its scene is already built: make a new "
                f"{type(self).__name__} with {name}={value!r}, and a new environment"
            )
        super().__setattr__(name, value)

    def fix(self, names: Iterable[str]) -> None:
        """Refuse changes of some attributes, because they would have no effect."""
        super().__setattr__("_fixed", self._fixed.union(names))

    def __repr__(self) -> str:
        shown = [
            f"{name}={vars(self)[attribute]!r}"
            for name in argument_names(type(self))
            for attribute in (name, f"_{name}")
            if attribute in vars(self)
        ]
        return f"{type(self).__name__}({', '.join(shown)})"


def load_class(package: str, path: str) -> Any:  # noqa: ANN401 (any class)
    """Import a class of a package, given as ``module:Class``."""
    module, name = path.split(":")
    return getattr(import_module(f"{package}.{module}"), name)


def check_call(
    owner: str, function: Callable[..., object], names: Iterable[str]
) -> None:
    """Refuse arguments that a function or class does not have.

    A function with ``**options`` accepts any name, so it is not checked here.

    Args:
        owner: Name of the function, for the error.
        function: Function or class that is going to be called.
        names: Names of the arguments in the call.

    Raises:
        TypeError: A name is not accepted.
    """
    # Before Python 3.11, the signature of a class was that of `Configured.__new__`, if
    # the class inherited its `__init__`.
    called = function
    if isinstance(function, type):
        called = function.__init__  # type: ignore[misc]  # of this very class
    parameters = inspect.signature(called).parameters
    if not _has_options(parameters):
        check_names(owner, names, [name for name in parameters if name != "self"])


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
        similar = difflib.get_close_matches(name, accepted, n=1)
        hint = f"did you mean {similar[0]!r}? " if similar else ""
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
            parameters = inspect.signature(vars(base)["__init__"]).parameters
            names += [name for name in parameters if name not in names]
            if not _has_options(parameters):
                break
    return names


def arguments_in(owner: type, method: str) -> set[str]:
    """Names of the arguments of a class that occur in the code of a method.

    Arguments that only other functions read for this method are not included.
    """
    functions = [vars(base).get(method) for base in owner.__mro__]
    names = {
        name
        for function in functions
        if isinstance(function, FunctionType)
        for name in function.__code__.co_names
    }
    return names.intersection(argument_names(owner))


def _has_options(parameters: Mapping[str, inspect.Parameter]) -> bool:
    return any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters.values())
