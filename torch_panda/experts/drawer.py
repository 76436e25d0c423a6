"""The scripted expert for Drawer."""

import torch
from torch import Tensor

from torch_panda.experts.moves import go_over, move

# The fingers act in the gap between the handle's bar and the front of the drawer. All
# distances are in metres.
BAR_TO_GAP = 0.03  # distance from the bar to the middle of the gap, along x
GAP_X = 0.025  # largest distance from this middle at which the hand is in the gap, x
GAP_Y = 0.045  # the same along y, the direction of the bar
GAP_Z = 0.01  # largest height above the middle of the gap at which the hand is in it
CLEARANCE = 0.015  # distance between the fingers and the bar or the front
DONE = 0.008  # distance from the goal at which the hand stops


def act(observation: Tensor, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
    """Reach behind the handle's bar from above, and pull it or push the front."""
    ee, handle = observation[..., :3], achieved_goal
    gap = handle + handle.new_tensor((BAR_TO_GAP, 0.0, 0.0))
    x, y, z = (gap - ee).split(1, -1)
    is_in_gap = (x.abs() < GAP_X) & (y.abs() < GAP_Y) & (z > -GAP_Z)
    remaining = (desired_goal - handle)[..., :1]
    # The fingers cross the clearance before they move the drawer.
    step = remaining + CLEARANCE * remaining.sign()
    step = torch.where(remaining.abs() < DONE, 0.0, step)
    move_drawer = move(torch.cat((step, torch.zeros_like(y), z), -1))
    return torch.where(is_in_gap, move_drawer, go_over(ee, gap, 0.05))
