"""Goal-conditioned implicit Q-learning, GCIQL (IQL: arXiv 2110.06169).

V(s, g) is an expectile of Q(s, a, g) over the actions of the data, and Q regresses to
r + discount * V(s', g), so that no value of an action outside the data is needed. As in
OGBench (arXiv 2410.20092) the policy ascends Q and imitates the data, DDPG+BC.
"""

import copy
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import hold_out_net

from torch_panda.learning.offline.base import (
    Actor,
    Batch,
    Ensemble,
    OfflineAgent,
    OfflineHyperparameters,
    ascend_and_imitate,
    expectile_loss,
    log_prob,
    make_gelu_mlp,
    move_towards,
)
from torch_panda.learning.spaces import Spaces


class GCIQL(OfflineAgent):
    """Values V(s, g) and Q(s, a, g), and a policy pi(a | s, g) that ascends Q.

    Args:
        spaces: Sizes and layout of observations, goals and actions.
        hp: Hyperparameters.
        expectile: Expectile of the values, tau in the paper.
    """

    # Expectile and alpha are those of OGBench's code. In its commands for cube tasks,
    # OGBench sets alpha to 0.03 (noisy) or 1 (play).
    default_alpha: ClassVar = 0.3

    def __init__(
        self, spaces: Spaces, hp: OfflineHyperparameters, *, expectile: float = 0.9
    ) -> None:
        super().__init__(spaces, hp)
        self.expectile = expectile
        inputs, action_size = len(self.normalizer.mean), spaces.action_size
        self.value = make_gelu_mlp(inputs, 1)
        self.critic = Ensemble(inputs + action_size)
        self.target_critic = copy.deepcopy(self.critic).requires_grad_(False)
        self.actor = Actor(self.normalizer, action_size)
        self.assemble(self.actor)

    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """The losses of V, Q and policy."""
        b = Batch.from_tensordict(batch)
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
            target = b.r + self.hp.discount * b.mask * v_next
        q = self.critic(self.normalizer(b.s, b.g), b.a)
        return (q - target).square().sum(0).mean()

    def actor_loss(self, b: Batch) -> Tensor:
        """DDPG+BC, instead of the paper's weighted imitation (eq. 7)."""
        mean = self.actor(b.s, b.g_actor)
        with hold_out_net(self.critic):
            x = self.normalizer(b.s, b.g_actor)
            q = self.critic(x, mean.clamp(-1.0, 1.0)).amin(0)
        return ascend_and_imitate(q, log_prob(mean, b.a), self.alpha)

    def move_targets(self) -> None:
        """Move the target critics towards the critics."""
        move_towards(self.target_critic, self.critic)
