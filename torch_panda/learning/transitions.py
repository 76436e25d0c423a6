"""A batch of transitions, as plain tensors: cheaper to pass on than TensorDicts."""

from typing import NamedTuple

from tensordict import TensorDictBase
from torch import Tensor


class Transitions(NamedTuple):
    """Of n rows, as sampled from a replay buffer.

    Attributes:
        observation: (n, observation size).
        goal: desired before and after the step, (n, goal size).
        action: (n, action size).
        reward: (n, 1).
        terminated: whether no return follows, (n, 1) bool.
        next_observation: (n, observation size).
    """

    observation: Tensor
    goal: Tensor
    action: Tensor
    reward: Tensor
    terminated: Tensor
    next_observation: Tensor

    @classmethod
    def from_tensordict(cls, batch: TensorDictBase) -> "Transitions":
        """Take what an agent learns from out of a batch with torchrl's keys."""
        following = batch.get("next")
        return cls(
            batch.get("observation"),
            batch.get("desired_goal"),
            batch.get("action"),
            following.get("reward"),
            following.get("terminated"),
            following.get("observation"),
        )
