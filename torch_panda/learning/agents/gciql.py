"""Goal-conditioned implicit Q-learning, GCIQL (IQL: arXiv 2110.06169).

V(s, g) is an expectile of Q(s, a, g) over the actions of the data, and Q regresses to
r + discount * V(s', g), so that no value of an action outside the data is needed. As in
OGBench (arXiv 2410.20092) the policy ascends Q and imitates the data, DDPG+BC.
"""

from typing import ClassVar

import torch
from torch import Tensor

from torch_panda.learning.agents.base import Agent
from torch_panda.learning.agents.batch import Batch
from torch_panda.learning.agents.hyperparameters import Hyperparameters
from torch_panda.learning.agents.networks import Ensemble, freeze, make_mlp
from torch_panda.learning.agents.offline_losses import (
    OGBENCH_RATES,
    ascend_and_imitate,
    expectile_loss,
    log_prob,
    make_mean_policy,
)
from torch_panda.learning.environments.spaces import Spaces


class GCIQL(Agent):
    """Values V(s, g) and Q(s, a, g), and a policy pi(a | s, g) that ascends Q.

    Args:
        spaces: Sizes and layout of observations, goals and actions.
        hp: Hyperparameters.
        expectile: Expectile of the values, tau in the paper.
    """

    # Expectile and alpha are those of OGBench's code. In its commands for cube tasks,
    # OGBench sets alpha to 0.03 (noisy) or 1 (play).
    learning_rate, tau = OGBENCH_RATES
    default_alpha: ClassVar = 0.3

    def __init__(
        self, spaces: Spaces, hp: Hyperparameters, *, expectile: float = 0.9
    ) -> None:
        super().__init__(spaces, hp)
        self.expectile = expectile
        inputs, action_size = self.state_size, spaces.action_size
        self.value = make_mlp(inputs, 1, hp.network)
        self.critic = Ensemble(inputs + action_size, hp.network)
        self.target_critic = self.make_target(self.critic)
        self.actor = make_mlp(self.state_size, action_size, hp.network)
        self.assemble(make_mean_policy(self.actor))

    def losses(self, b: Batch) -> dict[str, Tensor]:
        """The losses of V, Q and policy."""
        return {
            "value_loss": self.value_loss(b),
            "critic_loss": self.critic_loss(b),
            "actor_loss": self.actor_loss(b),
        }

    def value_loss(self, b: Batch) -> Tensor:
        """Expectile regression of V to the smaller target Q (eq. 5)."""
        x = self.normalizer(b.s, b.g)
        with torch.no_grad():
            q = self.target_critic(x, b.a).amin(0)
        diff = q - self.value(x).squeeze(-1)
        return expectile_loss(diff, diff, self.expectile).mean()

    def critic_loss(self, b: Batch) -> Tensor:
        """Squared error of Q with respect to r + discount * V(s', g) (eq. 6)."""
        with torch.no_grad():
            v_next = self.value(self.normalizer(b.s_next, b.g)).squeeze(-1)
            target = b.r + self.discount(b) * ~b.ends * v_next
        q = self.critic(self.normalizer(b.s, b.g), b.a)
        return (q - target).square().sum(0).mean()

    def discount(self, b: Batch) -> float | Tensor:
        """Discount of the next value."""
        return self.gamma

    def actor_loss(self, b: Batch) -> Tensor:
        """DDPG+BC, instead of the paper's weighted imitation (eq. 7)."""
        x = self.normalizer(b.s, b.g_actor)
        mean = self.actor(x)
        q = freeze(self.critic)(x, mean.clamp(-1.0, 1.0)).amin(0)
        return ascend_and_imitate(q, log_prob(mean, b.a), self.alpha)
