"""The scripted expert for PegInsertion."""

import torch
from torch import Tensor

from torch_panda.experts.moves import move, norm

FITS = 0.0004  # largest distance from the hole's axis at which the peg goes down [m]
CLEAR = 0.034  # height of the waiting peg above the goal, so above the block [m]
INSIDE = 0.0285  # largest height above the goal at which the peg is in the hole [m]
DESCENT = 0.005  # largest descent in one step [m]
DONE = 0.002  # distance from the goal at which the hand stops [m]


def act(observation: Tensor, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
    """Bring the peg over the hole, and lower it when it fits."""
    offset = desired_goal - achieved_goal
    sideways, rise = offset[..., :2], offset[..., 2:]
    is_inside = rise > -INSIDE
    may_descend = is_inside | (norm(sideways) < FITS)
    descent = torch.where(rise.abs() < DONE, 0.0, rise.clamp(min=-DESCENT))
    # In the hole the walls guide the peg. A sideways move would press the peg against
    # them and rotate it.
    sideways = torch.where(is_inside, 0.0, sideways)
    vertical = torch.where(may_descend, descent, rise + CLEAR)
    return move(torch.cat((sideways, vertical), -1))
