"""Batches of transitions as tuples of tensors, which are faster than TensorDicts."""

from typing import NamedTuple

from tensordict import TensorDictBase
from torch import Tensor


class Transitions(NamedTuple):
    """A batch of n transitions.

    Attributes:
        observation: Observations before the step, (n, observation size).
        goal: Desired goals, which are the same before and after the step, (n, goal
            size).
        action: Actions, (n, action size).
        reward: Rewards, (n, 1).
        terminated: Whether the episode ends with this step for another reason than its
            step limit, (n, 1) bool. Targets of critics then have no next value.
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
