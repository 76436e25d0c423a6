"""Arguments by name: errors that list the accepted ones, and reprs that show them."""

import difflib
import inspect
from collections.abc import Collection, Iterable, Mapping

from typing_extensions import Self


class Configured:
    """Base of classes whose objects are configured by keyword arguments.

    An unknown argument raises a `TypeError` that lists the accepted ones. The ``repr``
    of an object shows its arguments, which it keeps as attributes of the same names.
    """

    def __new__(cls, *args: object, **arguments: object) -> Self:
        """Refuse unknown arguments."""
        parameters = inspect.signature(cls).parameters
        # A class with `**options` reads them itself, or passes them to its base class.
        if not _has_options(parameters):
            check_names(cls.__name__, arguments, parameters)
        return super().__new__(cls)

    def __repr__(self) -> str:
        attributes = vars(self)
        names = [name for name in _argument_names(type(self)) if name in attributes]
        shown = ", ".join(f"{name}={attributes[name]!r}" for name in names)
        return f"{type(self).__name__}({shown})"


def check_names(
    owner: str,
    names: Iterable[str],
    accepted: Collection[str],
    advice: Mapping[str, str] | None = None,
) -> None:
    """Refuse arguments that a function does not have.

    Args:
        owner: Function or class, as the error names it.
        names: Names of the arguments in a call.
        accepted: Names of the arguments that the function has.
        advice: Unknown names that are a habit from elsewhere, with the fix for each.

    Raises:
        TypeError: A name is not accepted.
    """
    for name in names:
        if name in accepted:
            continue
        hints = [f"{owner} has no argument {name!r}"]
        similar = difflib.get_close_matches(name, accepted, n=1)
        if advice and name in advice:
            hints.append(advice[name])
        elif similar:
            hints.append(f"did you mean {similar[0]!r}?")
        hints.append(f"accepted are {', '.join(accepted) or 'none'}")
        raise TypeError("; ".join(hints))


def _argument_names(owner: type) -> list[str]:
    """Names of the arguments of a class, and of its base where it passes options on."""
    names: list[str] = []
    for base in owner.__mro__:
        if "__init__" in vars(base):
            parameters = inspect.signature(vars(base)["__init__"]).parameters
            names += [name for name in parameters if name not in names]
            if not _has_options(parameters):
                break
    return names


def _has_options(parameters: Mapping[str, inspect.Parameter]) -> bool:
    return any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters.values())
