"""The scripted expert for PegInsertion."""

import torch
from torch import Tensor

from torch_panda.experts.moves import move, norm

FITS = 0.0004  # distance from the hole's axis at which the peg goes down [m]
CLEAR = 0.034  # height above the goal at which the peg is above the block [m]
INSIDE = 0.0285  # height above the goal below which the peg is in the hole [m]
SLOWLY = 0.005  # descent in one step [m]
DONE = 0.002  # distance from the goal at which the hand stops [m]


def act(observation: Tensor, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
    """Bring the peg over the hole, and lower it when it fits."""
    left = desired_goal - achieved_goal
    beside, rise = left[..., :2], left[..., 2:]
    inside = rise > -INSIDE
    goes_down = inside | (norm(beside) < FITS)
    down = torch.where(rise.abs() < DONE, 0.0, rise.clamp(min=-SLOWLY))
    # The walls lead the peg in the hole; pressing against them would rotate it.
    return move(
        torch.cat(
            (
                torch.where(inside, 0.0, beside),
                torch.where(goes_down, down, rise + CLEAR),
            ),
            -1,
        )
    )
