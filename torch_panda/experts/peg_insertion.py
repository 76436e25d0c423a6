"""The scripted expert for PegInsertion."""

import torch
from torch import Tensor

from torch_panda.experts.moves import move, norm

FITS = 0.0004  # [m] beside the hole's middle, where the peg's end goes down
CLEAR = 0.034  # [m] above its goal, where the peg's end is out of the block
INSIDE = 0.0285  # [m] above its goal, where it is in the hole
SLOWLY = 0.005  # [m] a step, at which it goes down
DONE = 0.002  # [m] above its goal, where it is left alone


def act(observation: Tensor, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
    """Bring the peg's end over the hole, and lower it once it fits."""
    left = desired_goal - achieved_goal
    beside, rise = left[..., :2], left[..., 2:]
    inside = rise > -INSIDE
    goes_down = inside | (norm(beside) < FITS)
    down = torch.where(rise.abs() < DONE, 0.0, rise.clamp(min=-SLOWLY))
    # In the hole its walls lead the peg: pressed against them it would turn.
    return move(
        torch.cat(
            (
                torch.where(inside, 0.0, beside),
                torch.where(goes_down, down, rise + CLEAR),
            ),
            -1,
        )
    )
