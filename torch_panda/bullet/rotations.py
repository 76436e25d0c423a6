"""Rotations of single vectors."""

from collections.abc import Sequence


def rotate(quaternion: Sequence[float], vector: Sequence[float]) -> list[float]:
    """Rotate a vector by a quaternion xyzw."""
    x, y, z, w = quaternion
    a, b, c = vector
    p, q, r = 2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)
    return [
        a + w * p + y * r - z * q,
        b + w * q + z * p - x * r,
        c + w * r + x * q - y * p,
    ]
