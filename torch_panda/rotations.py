"""Rotations by quaternions, which are xyzw throughout the package."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

NO_ROTATION = (0.0, 0.0, 0.0, 1.0)


def rotate(quaternion: Tensor, vector: Tensor) -> Tensor:
    """Rotate vectors by unit quaternions xyzw: (..., 4), (..., 3) -> (..., 3)."""
    axis, vector = torch.broadcast_tensors(quaternion[..., :3], vector)
    w, turn = quaternion[..., 3:], 2 * torch.linalg.cross(axis, vector)
    return vector + w * turn + torch.linalg.cross(axis, turn)


def rotation_vector_to_quaternion(vector: Tensor) -> Tensor:
    """Rotations about a vector by its length [rad]: (..., 3) to xyzw (..., 4)."""
    angle = torch.linalg.vector_norm(vector, dim=-1, keepdim=True)
    # sin(angle / 2) / angle, also where the angle is 0.
    factor = torch.sinc(angle / (2 * math.pi)) / 2
    return torch.cat((vector * factor, (angle / 2).cos()), dim=-1)


def rotation_distance(first: Tensor, second: Tensor) -> Tensor:
    """1 - <q, q'>^2 of unit quaternions, 0 to 1: (..., 4) each to (..., 1)."""
    return 1 - (first * second).sum(-1, keepdim=True).square()


def quaternion_product(first: Tensor, second: Tensor) -> Tensor:
    """First after second, in the frame that the first turns: xyzw (..., 4) each."""
    first, second = torch.broadcast_tensors(first, second)
    a, w = first[..., :3], first[..., 3:]
    b, v = second[..., :3], second[..., 3:]
    vector = w * b + v * a + torch.linalg.cross(a, b)
    return torch.cat((vector, w * v - (a * b).sum(-1, keepdim=True)), dim=-1)


def rotate_vector(quaternion: Sequence[float], vector: Sequence[float]) -> list[float]:
    """Rotate one vector by one quaternion xyzw, without tensors: (3,)."""
    x, y, z, w = quaternion
    a, b, c = vector
    p, q, r = 2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)
    return [
        a + w * p + y * r - z * q,
        b + w * q + z * p - x * r,
        c + w * r + x * q - y * p,
    ]
