"""Rotations as unit quaternions xyzw."""

import math
from collections.abc import Sequence
from functools import reduce

import torch
from torch import Tensor

NO_ROTATION = (0.0, 0.0, 0.0, 1.0)


def dot(first: Tensor, second: Tensor) -> Tensor:
    """Inner products of vectors (..., n), (..., 1).

    Elementwise sums and products give the same bits on every processor. torch's
    reductions do not, because their kernels fuse multiplications and additions on some
    processors.
    """
    return reduce(torch.add, (first * second).unbind(-1)).unsqueeze(-1)


def rotate(quaternion: Tensor, vector: Tensor) -> Tensor:
    """Rotate vectors, (..., 3), by quaternions, (..., 4).

    For q = (u, w) with vector part u, the result is v + w t + u x t with t = 2 u x v.
    """
    u, vector = torch.broadcast_tensors(quaternion[..., :3], vector)
    w, t = quaternion[..., 3:], 2 * torch.linalg.cross(u, vector)
    return vector + w * t + torch.linalg.cross(u, t)


def rotation_vector_to_quaternion(vector: Tensor) -> Tensor:
    """Quaternions, (..., 4), of rotation vectors, (..., 3).

    A rotation vector points along the axis, and its length is the angle [rad].
    """
    angle = torch.linalg.vector_norm(vector, dim=-1, keepdim=True)
    # sin(angle / 2) / angle, which sinc also defines at angle 0.
    factor = torch.sinc(angle / (2 * math.pi)) / 2
    return torch.cat((vector * factor, (angle / 2).cos()), dim=-1)


def rotation_distance(first: Tensor, second: Tensor) -> Tensor:
    """Distance 1 - <q, q'>^2 between quaternions, (..., 4) each, from 0 to 1.

    Returns:
        (..., 1). It is the squared sine of half the angle between the rotations.
    """
    return 1 - dot(first, second).square()


def quaternion_product(first: Tensor, second: Tensor) -> Tensor:
    """Product of quaternions, (..., 4) each.

    As a rotation, it is ``second`` followed by ``first``, both about the world's axes.
    Equally, it is ``first`` followed by ``second`` about the axes turned by ``first``.
    """
    # Elementwise, for the reason that `dot` gives.
    x, y, z, w = first.unbind(-1)
    a, b, c, v = second.unbind(-1)
    product = (
        w * a + v * x + (y * c - z * b),
        w * b + v * y + (z * a - x * c),
        w * c + v * z + (x * b - y * a),
        w * v - (x * a + y * b + z * c),
    )
    return torch.stack(product, dim=-1)


def inverse(quaternion: Tensor) -> Tensor:
    """Inverse rotations, (..., 4)."""
    return torch.cat((-quaternion[..., :3], quaternion[..., 3:]), -1)


def rotate_vector(quaternion: Sequence[float], vector: Sequence[float]) -> list[float]:
    """Rotate one vector by one quaternion, as `rotate` does, but without tensors."""
    x, y, z, w = quaternion
    a, b, c = vector
    p, q, r = 2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)
    return [
        a + w * p + y * r - z * q,
        b + w * q + z * p - x * r,
        c + w * r + x * q - y * p,
    ]


def euler_angles(x: float, y: float, z: float, w: float) -> tuple[float, float, float]:
    """Roll, pitch and yaw [rad] of a quaternion xyzw.

    Equals pybullet's ``getEulerFromQuaternion``. Near a pitch of 90 degrees only the
    sum or the difference of roll and yaw is defined, and roll is 0. ``client.c`` has
    the same function in C.
    """
    sine = -2 * (x * z - w * y)
    if abs(sine) >= 0.99999:
        side = math.copysign(1.0, sine)
        return 0.0, side * (math.pi / 2), 2 * math.atan2(-side * x, side * y)
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    roll = math.atan2(2 * (y * z + w * x), ww - xx - yy + zz)
    yaw = math.atan2(2 * (x * y + w * z), ww + xx - yy - zz)
    return roll, math.asin(sine), yaw
