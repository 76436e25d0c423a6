"""Batches of transitions as plain tensors, which cost less time than TensorDicts."""

from typing import NamedTuple

from tensordict import TensorDictBase
from torch import Tensor


class Transitions(NamedTuple):
    """n transitions from a replay buffer.

    Attributes:
        observation: Observations before the step, (n, observation size).
        goal: Desired goals before and after the step, (n, goal size).
        action: Actions, (n, action size).
        reward: Rewards, (n, 1).
        terminated: Whether the step ends the return, (n, 1) bool.
        next_observation: Observations after the step, (n, observation size).
    """

    observation: Tensor
    goal: Tensor
    action: Tensor
    reward: Tensor
    terminated: Tensor
    next_observation: Tensor

    @classmethod
    def from_tensordict(cls, batch: TensorDictBase) -> "Transitions":
        """Read the transitions from a batch with torchrl's keys."""
        following = batch.get("next")
        return cls(
            batch.get("observation"),
            batch.get("desired_goal"),
            batch.get("action"),
            following.get("reward"),
            following.get("terminated"),
            following.get("observation"),
        )
