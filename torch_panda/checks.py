"""Numbers that Bullet would take without a word."""

import math
from collections.abc import Sequence

from torch import Tensor


def check_quaternion(name: str, quaternion: Sequence[float]) -> None:
    """Make sure that a quaternion xyzw stands for a rotation.

    Raises:
        ValueError: it has no length, or is not finite.
    """
    length = math.hypot(*quaternion)
    if not (len(quaternion) == 4 and 0 < length < math.inf):
        raise ValueError(f"{name} must be a quaternion xyzw, got {tuple(quaternion)}")


def check_not_negative(**values: float | None) -> None:
    """Make sure that numbers are finite and not negative, or None.

    Raises:
        ValueError: one is not.
    """
    for name, value in values.items():
        if value is not None and not 0 <= value < math.inf:
            raise ValueError(f"{name} must be finite and at least 0, got {value}")


def all_finite(values: Tensor) -> bool:
    """Whether all numbers are finite; one operation where their sum is, too."""
    return math.isfinite(values.sum().item()) or bool(values.isfinite().all())
