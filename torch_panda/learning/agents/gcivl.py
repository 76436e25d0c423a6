"""Goal-conditioned implicit V-learning, GCIVL.

OGBench's name for the action-free values of HIQL (arXiv 2307.11949, section 3).

IQL (arXiv 2110.06169) without Q: an expectile of r + discount * V(s', g) over the
actions of the data approximates the maximum over these actions. This needs nearly
deterministic transitions: with random ones, the expectile would also favour lucky
outcomes of an action. The policy imitates actions in proportion to
exp(alpha * advantage).
"""

from typing import ClassVar

import torch
from torch import Tensor

from torch_panda.learning.agents.base import Agent
from torch_panda.learning.agents.batch import Batch
from torch_panda.learning.agents.hyperparameters import Hyperparameters
from torch_panda.learning.agents.networks import Ensemble, make_mlp
from torch_panda.learning.agents.offline_losses import (
    OGBENCH_RATES,
    ensemble_loss,
    log_prob,
    make_mean_policy,
    weighted_regression,
)
from torch_panda.learning.environments.spaces import Spaces


class GCIVL(Agent):
    """Values V(s, g), and a policy pi(a | s, g) that imitates good actions.

    Args:
        spaces: Sizes and layout of observations, goals and actions.
        hp: Hyperparameters.
        expectile: Expectile of the values, tau in the paper.
    """

    learning_rate, tau = OGBENCH_RATES
    default_alpha: ClassVar = 10.0  # OGBench's, as the expectile

    def __init__(
        self, spaces: Spaces, hp: Hyperparameters, *, expectile: float = 0.9
    ) -> None:
        super().__init__(spaces, hp)
        self.expectile = expectile
        self.value = Ensemble(self.state_size, hp.network)
        self.target_value = self.make_target(self.value)
        self.actor = make_mlp(self.state_size, spaces.action_size, hp.network)
        self.assemble(make_mean_policy(self.actor))

    def losses(self, b: Batch) -> dict[str, Tensor]:
        """The losses of value and policy."""
        return {"value_loss": self.value_loss(b), "actor_loss": self.actor_loss(b)}

    def value_loss(self, b: Batch) -> Tensor:
        """Expectile regression of V to its target (2307.11949, eq. 4)."""
        x, x_next = self.normalizer(b.s, b.g), self.normalizer(b.s_next, b.g)
        with torch.no_grad():
            q = b.r + self.gamma * ~b.ends * self.target_value(x_next)  # (2, n)
            v_target = self.target_value(x)
        return ensemble_loss(q, self.value(x), v_target, self.expectile)

    def actor_loss(self, b: Batch) -> Tensor:
        """Weighted imitation with A = V(s', g) - V(s, g) (2307.11949, eq. 5)."""
        x = self.normalizer(b.s, b.g_actor)
        with torch.no_grad():
            v = self.value(x).mean(0)
            v_next = self.value(self.normalizer(b.s_next, b.g_actor)).mean(0)
        log_probs = log_prob(self.actor(x), b.a)
        return weighted_regression(log_probs, v_next - v, self.alpha)
