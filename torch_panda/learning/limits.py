"""Limits of the commands' options, which are checked before a run starts.

A limit is part of the type of an option, such as ``batch_size: Positive``.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from math import inf, isfinite
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints


@dataclass(frozen=True)
class Limit:
    """A limit of a number.

    Attributes:
        description: The accepted numbers in words.
        holds: Whether a number is accepted.
    """

    description: str
    holds: Callable[[float], bool]


Positive = Annotated[int, Limit("positive", lambda x: x > 0)]
Count = Annotated[int, Limit("at least 0", lambda x: x >= 0)]
Seed = Annotated[int, Limit("from 0 to 2**64 - 1", lambda x: 0 <= x < 2**64)]
Port = Annotated[int, Limit("from 1 to 65535", lambda x: 1 <= x <= 65535)]
Weight = Annotated[float, Limit("at least 0 and finite", lambda x: 0 <= x < inf)]
Factor = Annotated[float, Limit("at least 1 and finite", lambda x: 1 <= x < inf)]
Ratio = Annotated[float, Limit("from 0 to 1", lambda x: 0 <= x <= 1)]
Finite = Annotated[float, Limit("finite", isfinite)]
Discount = Annotated[float, Limit("above 0 and at most 1", lambda x: 0 < x <= 1)]


def check_limits(args: object) -> None:
    """Check the options of a command. A number that is None is always accepted.

    Raises:
        ValueError: An option is out of its limits, or not one of its choices.
    """
    check_choices(type(args), vars(args))
    for name, hint in get_type_hints(type(args), include_extras=True).items():
        value = getattr(args, name)
        numbers = value if isinstance(value, tuple) else (value,)
        if isinstance(value, dict):
            numbers = tuple(value.values())
        for limit in find_limits(hint):
            if not all(number is None or limit.holds(number) for number in numbers):
                raise ValueError(f"{name} must be {limit.description}, got {value}")


def check_choices(options: type, values: Mapping[str, Any]) -> None:
    """Check the values of options that have a `Literal` as their type.

    Args:
        options: Dataclass of the options.
        values: Values of some of the options, by name.

    Raises:
        ValueError: A value is not one of the choices.
    """
    for name, hint in get_type_hints(options).items():
        choices = get_args(hint) if get_origin(hint) is Literal else ()
        if choices and name in values and values[name] not in choices:
            raise ValueError(
                f"{name} must be one of {', '.join(choices)}, got {values[name]!r}"
            )


def find_limits(hint: Any) -> Iterator[Limit]:  # noqa: ANN401 (any type)
    """Yield the limits in a type, also those inside a union or a tuple."""
    for part in get_args(hint):
        if isinstance(part, Limit):
            yield part
        else:
            yield from find_limits(part)
