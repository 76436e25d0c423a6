"""Goal-conditioned implicit V-learning, GCIVL.

OGBench's name for the action-free values of HIQL (arXiv 2307.11949, section 3).

IQL (arXiv 2110.06169) without Q: an expectile of r + discount * V(s', g) over the
actions of the data approximates the maximum over these actions. This needs nearly
deterministic transitions: with random ones, the expectile would also favour lucky
outcomes of an action. The policy imitates actions in proportion to
exp(alpha * advantage).
"""

import copy
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torch_panda.learning.offline.base import (
    Actor,
    Batch,
    Ensemble,
    OfflineAgent,
    OfflineHyperparameters,
    ensemble_loss,
    log_prob,
    move_towards,
    weighted_regression,
)
from torch_panda.learning.spaces import Spaces


class GCIVL(OfflineAgent):
    """Values V(s, g), and a policy pi(a | s, g) that imitates good actions.

    Args:
        spaces: Sizes and layout of observations, goals and actions.
        hp: Hyperparameters.
        expectile: Expectile of the values, tau in the paper.
    """

    default_alpha: ClassVar = 10.0  # OGBench's, as the expectile

    def __init__(
        self, spaces: Spaces, hp: OfflineHyperparameters, *, expectile: float = 0.9
    ) -> None:
        super().__init__(spaces, hp)
        self.expectile = expectile
        self.value = Ensemble(len(self.normalizer.mean))
        self.target_value = copy.deepcopy(self.value).requires_grad_(False)
        self.actor = Actor(self.normalizer, spaces.action_size)
        self.assemble(self.actor)

    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """The losses of value and policy."""
        b = Batch.from_tensordict(batch)
        return {"value_loss": self.value_loss(b), "actor_loss": self.actor_loss(b)}

    def value_loss(self, b: Batch) -> Tensor:
        """Expectile regression of V to its target (2307.11949, eq. 4)."""
        x, x_next = self.normalizer(b.s, b.g), self.normalizer(b.s_next, b.g)
        with torch.no_grad():
            q = b.r + self.hp.discount * b.mask * self.target_value(x_next)  # (2, n)
            v_target = self.target_value(x)
        return ensemble_loss(q, self.value(x), v_target, self.expectile)

    def actor_loss(self, b: Batch) -> Tensor:
        """Weighted imitation with A = V(s', g) - V(s, g) (2307.11949, eq. 5)."""
        with torch.no_grad():
            v = self.value(self.normalizer(b.s, b.g_actor)).mean(0)
            v_next = self.value(self.normalizer(b.s_next, b.g_actor)).mean(0)
        log_probs = log_prob(self.actor(b.s, b.g_actor), b.a)
        return weighted_regression(log_probs, v_next - v, self.alpha)

    def move_targets(self) -> None:
        """Move the target values towards the values."""
        move_towards(self.target_value, self.value)
