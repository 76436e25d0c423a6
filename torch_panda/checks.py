"""Argument checks. This module imports nothing of the package, so all may import it."""

import math
import operator
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress

import torch
from torch import Tensor

# Largest deviation of a quaternion's length from 1.
QUATERNION_TOLERANCE = 1e-3


# ---- numbers and names -------------------------------------------------------


def check_integer(name: str, value: int) -> int:
    """Return an integer of any type as an ``int``.

    Raises:
        TypeError: ``value`` is a boolean or not an integer.
    """
    if not isinstance(value, bool):  # torch does not take a boolean as a size either
        with suppress(TypeError):
            return operator.index(value)
    raise TypeError(f"{name} must be an integer, got {value!r}")


def check_positive(**arguments: int | None) -> None:
    """Check that arguments are integers of at least 1, or None.

    Raises:
        ValueError: An argument is below 1 or does not fit into 64 bits.
        TypeError: An argument is not an integer.
    """
    for name, value in arguments.items():
        if value is not None and not 1 <= check_integer(name, value) <= sys.maxsize:
            raise ValueError(
                f"{name} must be None or from 1 to {sys.maxsize}, got {value}"
            )


def check_seed(seed: int) -> int:
    """Return a seed as an ``int``.

    Raises:
        ValueError: The seed is negative.
        TypeError: The seed is not an integer.
    """
    number = check_integer("seed", seed)
    if number < 0:
        raise ValueError(f"seed must be a non-negative integer, got {seed}")
    return number


def check_finite(**values: float) -> None:
    """Check that arguments are finite numbers.

    Raises:
        ValueError: An argument is not finite.
        TypeError: An argument is not a number.
    """
    _check_numbers(values, lambda value: True, "finite")


def check_not_negative(**values: float) -> None:
    """Check that arguments are finite and at least 0; see `check_finite`."""
    _check_numbers(values, lambda value: value >= 0, "finite and at least 0")


def check_above_zero(**values: float) -> None:
    """Check that arguments are finite and above 0; see `check_finite`."""
    _check_numbers(values, lambda value: value > 0, "finite and above 0")


def _check_numbers(
    values: Mapping[str, float], is_valid: Callable[[float], bool], requirement: str
) -> None:
    """Check numbers, given by the names of the arguments."""
    for name, value in values.items():
        try:
            accepted = math.isfinite(value) and is_valid(value)
        except (TypeError, ValueError):  # a tensor of several numbers: ValueError
            raise TypeError(f"{name} must be a number, got {value!r}") from None
        if not accepted:
            raise ValueError(f"{name} must be {requirement}, got {value}")


def check_vector(name: str, values: Sequence[float]) -> tuple[float, float, float]:
    """Return three finite numbers, such as a position, as floats.

    Raises:
        ValueError: The values are not three, or one is not a finite number.
    """
    try:
        x, y, z = (float(value) for value in values if not isinstance(value, str))
    except (TypeError, ValueError):
        x, y, z = math.nan, math.nan, math.nan
    if not all(map(math.isfinite, (x, y, z))):
        raise ValueError(f"{name} must be three finite numbers, got {values!r}")
    return x, y, z


def check_range(name: str, value: Sequence[float]) -> None:
    """Check that an argument is a pair (lowest, highest) of non-negative numbers.

    Raises:
        ValueError: The argument is not such a pair.
    """
    try:
        low, high = map(float, value)
    except (TypeError, ValueError):
        low, high = math.nan, math.nan
    if not 0 <= low <= high < math.inf:
        raise ValueError(
            f"{name} must be (lowest, highest), finite and at least 0, got {value!r}"
        )


def check_choice(name: str, value: object, choices: Collection[object]) -> None:
    """Check that an argument is one of several values.

    Raises:
        ValueError: The argument is not one of these values.
    """
    if value not in choices:
        raise ValueError(f"{name} must be one of {tuple(choices)}, got {value!r}")


def check_instance(name: str, value: object, expected: type) -> None:
    """Check that an argument is an instance of a class.

    Raises:
        TypeError: The argument is an instance of another class, or a class itself.
    """
    if not isinstance(value, expected):
        got = f"the class {value.__name__}" if isinstance(value, type) else repr(value)
        raise TypeError(f"{name} must be an instance of {expected.__name__}, got {got}")


# ---- the machine -------------------------------------------------------------


def check_device(device: torch.device | str | int | None) -> torch.device:
    """Return a device that torch can use; None means the CPU.

    Raises:
        ValueError: torch does not know the device, or cannot use it.
    """
    try:
        usable = torch.device("cpu" if device is None else device)
        torch.zeros(1, device=usable).item()
    except (RuntimeError, AssertionError, ImportError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(
            f"device must be one that torch can use here, such as cpu, got "
            f"{device!r}: {reason}"
        ) from None
    return usable


def all_finite(values: Tensor) -> bool:
    """Whether all numbers are finite."""
    # The sum is finite only if all numbers are, and computing it is faster than calling
    # `isfinite`. But a sum of finite numbers may overflow, so `isfinite` decides then.
    return math.isfinite(values.sum().item()) or bool(values.isfinite().all())


def check_rows(
    name: str, is_valid: Tensor, envs: Sequence[int], requirement: str
) -> None:
    """Check that a tensor with one row per environment has only valid entries.

    Args:
        name: Name of the tensor, for the error.
        is_valid: Whether each entry is valid, (len(envs), ...) bool.
        envs: The environments of the rows.
        requirement: End of the error message "... must be ...".

    Raises:
        ValueError: An entry is not valid. The error names the first such environment.
    """
    if not is_valid.all():
        env = envs[int((~is_valid).flatten(1).any(dim=1).nonzero()[0])]
        raise ValueError(f"{name} of environment {env} must be {requirement}")


# ---- rotations ---------------------------------------------------------------


def check_quaternion(name: str, quaternion: Sequence[float]) -> None:
    """Check that four numbers are a quaternion xyzw of any positive length.

    Raises:
        ValueError: The numbers are not four, are all 0, or are not finite.
    """
    length = math.hypot(*quaternion)
    if not (len(quaternion) == 4 and 0 < length < math.inf):
        raise ValueError(
            f"{name} must be a quaternion xyzw, four finite numbers that are not all "
            f"0, got {tuple(quaternion)}"
        )


def check_rotations(name: str, pose: Tensor, envs: Sequence[int]) -> None:
    """Check that poses end in unit quaternions.

    Args:
        name: Name of the tensor, for the error.
        pose: Positions [m] and quaternions xyzw, (len(envs), ..., 7).
        envs: The environments of the rows.

    Raises:
        ValueError: A quaternion is not a unit quaternion.
    """
    norm = torch.linalg.vector_norm(pose[..., 3:], dim=-1)
    is_unit = (norm - 1).abs() < QUATERNION_TOLERANCE
    check_rows(name, is_unit, envs, "a position and a unit quaternion")
