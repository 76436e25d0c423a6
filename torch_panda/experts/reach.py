"""The scripted expert for Reach."""

from torch import Tensor

from torch_panda.experts.moves import move


def act(observation: Tensor, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
    """Go straight to the goal."""
    return move(desired_goal - achieved_goal)
