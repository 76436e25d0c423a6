"""The scripted expert for PegInsertion."""

import torch
from torch import Tensor

from experts.moves import move, norm

FITS = 0.0004  # [m] beside the hole's middle, where the peg's end goes down
CLEAR = 0.034  # [m] above its goal, where the peg's end is out of the block
INSIDE = 0.0285  # [m] above its goal, where it is in the hole
SLOWLY = 0.005  # [m] a step, at which it goes down


def act(observation: Tensor, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
    """Bring the peg's end over the hole, and lower it once it fits."""
    left = desired_goal - achieved_goal
    beside, rise = left[..., :2], left[..., 2:]
    goes_down = (norm(beside) < FITS) | (rise > -INSIDE)
    down = rise.clamp(min=-SLOWLY)
    return move(torch.cat((beside, torch.where(goes_down, down, rise + CLEAR)), -1))
