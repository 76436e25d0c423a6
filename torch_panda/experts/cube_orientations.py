"""Orientations of a cube as quaternions xyzw, (..., 4).

Orientations in which the edges of the cube are parallel to the world's axes are called
straight. There are 24 of them.
"""

import functools
import math

import torch
from torch import Tensor

from torch_panda.rotations import dot
from torch_panda.rotations import quaternion_product as compose


def to_matrix(quaternion: Tensor) -> Tensor:
    """Matrices of rotations, (..., 3, 3)."""
    x, y, z, w = quaternion.unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def same_half(quaternion: Tensor) -> Tensor:
    """Negate quaternions with w < 0, which does not change the rotation, (..., 4)."""
    return quaternion * torch.where(quaternion[..., 3:] < 0, -1.0, 1.0)


def turn(axis: int, angle: Tensor) -> Tensor:
    """Rotations about a world axis by angles [rad] (..., 1), (..., 4)."""
    parts = [torch.zeros_like(angle)] * 3
    # Math libraries differ in the last bits of sines. Rounding to the dtype of `angle`
    # removes these bits.
    half = angle.double() / 2
    parts[axis] = half.sin().to(angle)
    return torch.cat((*parts, half.cos().to(angle)), -1)


def best_pitch(start: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
    """Find the rotation about y that comes closest to a goal.

    Args:
        start: Orientations before the rotation, (..., 4).
        goal: Orientations of the goal, (..., 4).

    Returns:
        The distance to the goal after the rotation, and the angle of the rotation
        [rad], (..., 1) each.
    """
    half_turn = compose(start.new_tensor((0.0, 1.0, 0.0, 0.0)), start)
    cosine, sine = dot(goal, start), dot(goal, half_turn)
    angle = 2 * torch.atan2(sine.double(), cosine.double()).to(start)
    angle = torch.remainder(angle + math.pi, 2 * math.pi) - math.pi
    return 1 - cosine.square() - sine.square(), angle


def _straight_orientations() -> Tensor:
    """Compute the straight orientations, (24, 4)."""
    quarters = torch.arange(4.0)[:, None] * math.pi / 2
    faces = torch.cat((turn(0, quarters), turn(1, quarters[1::2])))
    return compose(turn(2, quarters)[:, None], faces).flatten(0, 1)


STRAIGHT = _straight_orientations()


@functools.cache
def straight_orientations(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Copy `STRAIGHT`, once for each device: CUDA graphs do not copy from the CPU."""
    return STRAIGHT.to(device, dtype)


def straighten(cube: Tensor) -> Tensor:
    """Return the nearest straight orientation of each cube, (..., 4)."""
    straight = straight_orientations(cube.dtype, cube.device)
    return straight[dot(cube[..., None, :], straight).squeeze(-1).abs().argmax(-1)]
