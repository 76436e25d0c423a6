"""Rotations."""

import math

import torch
from torch import Tensor

NO_ROTATION = (0.0, 0.0, 0.0, 1.0)


def quaternion_to_euler(quaternion: Tensor) -> Tensor:
    """Roll, pitch and yaw [rad] of quaternions xyzw: (..., 4) -> (..., 3).

    As pybullet's ``getEulerFromQuaternion``: near a pitch of 90 degrees, where only the
    sum or difference of the others is defined, roll is 0.
    """
    # Some 30 operations on a few numbers each: plain floats take a third of the time
    # of tensors, and give the bits of the C library's functions.
    angles = [_euler_angles(*row) for row in quaternion.reshape(-1, 4).tolist()]
    return quaternion.new_tensor(angles).reshape(*quaternion.shape[:-1], 3)


def rotate(quaternion: Tensor, vector: Tensor) -> Tensor:
    """Rotate vectors by unit quaternions xyzw: (..., 4), (..., 3) -> (..., 3)."""
    axis, vector = torch.broadcast_tensors(quaternion[..., :3], vector)
    w, turn = quaternion[..., 3:], 2 * torch.linalg.cross(axis, vector)
    return vector + w * turn + torch.linalg.cross(axis, turn)


def _euler_angles(x: float, y: float, z: float, w: float) -> tuple[float, float, float]:
    sine = -2 * (x * z - w * y)
    if abs(sine) >= 0.99999:
        side = math.copysign(1.0, sine)
        return 0.0, side * (math.pi / 2), 2 * math.atan2(-side * x, side * y)
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    roll = math.atan2(2 * (y * z + w * x), ww - xx - yy + zz)
    yaw = math.atan2(2 * (x * y + w * z), ww + xx - yy - zz)
    return roll, math.asin(sine), yaw
