"""Rotations of the hand."""

import math

import torch
from torch import Tensor


def rotation_vector_to_quaternion(vector: Tensor) -> Tensor:
    """Rotations about a vector by its length [rad]: (..., 3) to xyzw (..., 4)."""
    angle = torch.linalg.vector_norm(vector, dim=-1, keepdim=True)
    # sin(angle / 2) / angle, also where the angle is 0.
    factor = torch.sinc(angle / (2 * math.pi)) / 2
    return torch.cat((vector * factor, (angle / 2).cos()), dim=-1)


def quaternion_product(first: Tensor, second: Tensor) -> Tensor:
    """First after second, in the frame that the first turns: xyzw (..., 4) each."""
    a, w = first[..., :3], first[..., 3:]
    b, v = second[..., :3], second[..., 3:]
    vector = w * b + v * a + torch.linalg.cross(a, b)
    return torch.cat((vector, w * v - (a * b).sum(-1, keepdim=True)), dim=-1)
