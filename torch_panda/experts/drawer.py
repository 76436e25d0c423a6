"""The scripted expert for Drawer."""

import torch
from torch import Tensor

from torch_panda.experts.moves import go_over, move

BEHIND = 0.03  # [m] from the handle's bar to the middle between it and the front
REACH = 0.025  # [m] from bar to front that the hand may be off that middle
BESIDE = 0.045  # [m] along the bar, which ends farther from its middle
LOW = 0.01  # [m] above the bar's middle, below which the fingers hook it
PLAY = 0.015  # [m] that the fingers move until they touch bar or front
DONE = 0.008  # [m] from the goal, where the drawer is left alone


def act(observation: Tensor, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
    """Reach behind the handle's bar from above, and pull it or push the front."""
    ee, handle = observation[..., :3], achieved_goal
    middle = handle + handle.new_tensor((BEHIND, 0.0, 0.0))
    offset = middle - ee
    x, y, z = offset.split(1, -1)
    hooked = (x.abs() < REACH) & (y.abs() < BESIDE) & (z > -LOW)
    left = (desired_goal - handle)[..., :1]
    slide = torch.where(left.abs() < DONE, 0.0, left + PLAY * left.sign())
    along = move(torch.cat((slide, torch.zeros_like(y), z), -1))
    return torch.where(hooked, along, go_over(ee, middle, 0.05))
