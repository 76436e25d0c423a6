"""The scripted expert for Drawer."""

import torch
from torch import Tensor

from torch_panda.experts.moves import go_over, move

BEHIND = 0.03  # from the handle's bar to the middle between bar and front [m]
REACH = 0.025  # distance from this middle at which the hand is still inside [m]
BESIDE = 0.045  # the same along the bar, which is longer [m]
LOW = 0.01  # height above the bar's middle below which the fingers hook it [m]
GAP = 0.015  # distance between the fingers and the bar or the front [m]
DONE = 0.008  # distance from the goal at which the hand stops [m]


def act(observation: Tensor, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
    """Reach behind the handle's bar from above, and pull it or push the front."""
    ee, handle = observation[..., :3], achieved_goal
    middle = handle + handle.new_tensor((BEHIND, 0.0, 0.0))
    offset = middle - ee
    x, y, z = offset.split(1, -1)
    hooked = (x.abs() < REACH) & (y.abs() < BESIDE) & (z > -LOW)
    left = (desired_goal - handle)[..., :1]
    slide = torch.where(left.abs() < DONE, 0.0, left + GAP * left.sign())
    along = move(torch.cat((slide, torch.zeros_like(y), z), -1))
    return torch.where(hooked, along, go_over(ee, middle, 0.05))
