"""The scripted expert for PickAndPlace."""

from torch import Tensor

from torch_panda.experts.moves import carry


def act(observation: Tensor, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
    """Carry the cube to the goal and hold it there."""
    ee, width = observation[..., :3], observation[..., 6:7]
    return carry(ee, width, achieved_goal, desired_goal)
