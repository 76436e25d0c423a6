"""Moves that the scripted experts combine.

Positions and offsets are in the world frame [m]. An action of 1 displaces the
end-effector by 5 cm. Data sets should have the same hashes on every processor. So all
arithmetic is elementwise, and `sqrt` below computes all square roots.
"""

import torch
from torch import Tensor

from torch_panda.rotations import dot

GAIN = 0.8 / 0.05  # action per metre of offset; a step covers 0.8 of the offset
GRIPPER = 0.2  # distance by which an action of 1 opens the fingers [m]
OPEN = 0.075  # distance between the fingers before a grasp [m]
# Deceleration of a cube that slides on the table of -v3 [m/s^2]: the friction of a
# contact is the product of the frictions of cube and table, 0.5 * 0.5. In Stack-v1 it
# is 5 * 0.1, so cubes stop sooner.
DECELERATION = 0.25 * 9.81


def norm(vector: Tensor) -> Tensor:
    """Lengths (..., 1) of vectors (..., n)."""
    return sqrt(dot(vector, vector))


def sqrt(values: Tensor) -> Tensor:
    """Square roots with the same bits on every processor.

    In float32, torch leaves roots to MKL, whose last bit depends on the processor. The
    root in float64, rounded to float32, does not.
    """
    return values.double().sqrt().to(values.dtype)


def unit(vector: Tensor) -> Tensor:
    """Directions of vectors, (..., n)."""
    return vector / norm(vector).clamp(min=1e-6)


def move(offset: Tensor, limit: float = 1.0) -> Tensor:
    """The action for an offset [m], with a length of at most ``limit``."""
    action = GAIN * offset
    return action / (norm(action) / limit).clamp(min=1.0)


def go_over(
    position: Tensor, point: Tensor, clearance: float, limit: float = 1.0
) -> Tensor:
    """Move to a point from above: travel at a height, and descend over the point.

    Args:
        position: Present position, (..., 3).
        point: Point to reach, (..., 3).
        clearance: Height above the point [m] at which the hand travels until it is
            almost over the point.
        limit: Largest length of the action.
    """
    offset = point - position
    height = (2 * (norm(offset[..., :2]) - 0.01)).clamp(0.0, clearance)
    rise = offset[..., 2:] + height
    # Share of the sideways motion: 1 at the wanted height, 0 if 5 cm or more below it.
    sideways = (1 - rise / 0.05).clamp(0.0, 1.0)
    return move(torch.cat((offset[..., :2] * sideways, rise), -1), limit)


def push_to(ee: Tensor, cube: Tensor, velocity: Tensor, goal: Tensor) -> Tensor:
    """Go behind a cube, seen from the goal, and push until it will slide to the goal.

    Args:
        ee: Position of the end-effector, (..., 3).
        cube: Position of the cube, (..., 3).
        velocity: Velocity of the cube along x and y [m/s], (..., 2).
        goal: Position to which the cube should go, (..., 3).
    """
    offset, beside, height = (goal - cube)[..., :2], (ee - cube)[..., :2], cube[..., 2:]
    distance, direction = norm(offset), unit(offset)
    along = dot(beside, direction)
    lateral = beside - along * direction
    behind = torch.cat((cube[..., :2] - 0.06 * direction, height), -1)
    pushing = (along < -0.02) & (norm(lateral) < 0.02) & (ee[..., 2:] < height + 0.02)
    # Distance to the goal from the point at which the cube will stop by itself.
    remaining = distance - dot(velocity, velocity) / (2 * DECELERATION)
    step = (0.5 * remaining).clamp(0.0, 0.025) * direction - lateral
    advance = move(torch.cat((step, height - ee[..., 2:]), -1))
    # Leave a cube within 3 cm of the goal alone, because another approach would
    # disturb it.
    done = (remaining < 0.01) | ~pushing & (distance < 0.03)
    action = torch.where(pushing, advance, go_over(ee, behind, 0.06))
    return torch.where(done, 0.0, action)


def is_held(ee: Tensor, width: Tensor, cube: Tensor) -> Tensor:
    """Whether the fingers hold a cube, which may be rotated, or off-centre along y."""
    offset = (cube - ee).abs() < ee.new_tensor((0.02, 0.04, 0.02))
    return (width > 0.02) & (width < 0.057) & offset.all(-1, keepdim=True)


def open_to(width: Tensor, wanted: float | Tensor) -> Tensor:
    """The gripper's action towards a distance between the fingers [m]."""
    return ((wanted - width) / GRIPPER).clamp(-1.0, 1.0)


def carry(
    ee: Tensor, width: Tensor, cube: Tensor, goal: Tensor, clearance: float = 0.0
) -> Tensor:
    """Grasp a cube and carry it to a point.

    Args:
        ee: Position of the end-effector, (..., 3).
        width: Distance between the fingers, (..., 1).
        cube: Position of the cube, (..., 3).
        goal: Position to which the cube should go, (..., 3).
        clearance: Height above the goal from which the cube is lowered [m].

    Returns:
        The action with the gripper's entry, (..., 4).
    """
    offset = cube - ee
    near = (norm(offset[..., :2]) < 0.015) & (offset[..., 2:].abs() < 0.01)
    held = is_held(ee, width, cube)
    transport = go_over(cube, goal, clearance, limit=0.6)
    displacement = torch.where(held, transport, go_over(ee, cube, 0.1))
    gripper = torch.where(near | held, -1.0, open_to(width, OPEN))
    return torch.cat((displacement, gripper), -1)
