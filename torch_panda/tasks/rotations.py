"""Rotations."""

import torch
from torch import Tensor

NO_ROTATION = (0.0, 0.0, 0.0, 1.0)


def rotate(quaternion: Tensor, vector: Tensor) -> Tensor:
    """Rotate vectors by unit quaternions xyzw: (..., 4), (..., 3) -> (..., 3)."""
    axis, vector = torch.broadcast_tensors(quaternion[..., :3], vector)
    w, turn = quaternion[..., 3:], 2 * torch.linalg.cross(axis, vector)
    return vector + w * turn + torch.linalg.cross(axis, turn)
