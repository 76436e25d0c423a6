"""Contrastive reinforcement learning, CRL (arXiv 2206.07568).

The critic f(s, a, g) = phi(s, a)^T psi(g) is a classifier. Its positive goals are
achieved k steps after (s, a), with probability proportional to discount**k. Its
negative goals are those of other rows. As in OGBench, there are two critics, and f is
divided by the square root of the size of phi. At its optimum, f is
log(p(g | s, a) / p(g)) plus a constant. Here p(g | s, a) is the discounted probability
of reaching g after (s, a), and p(g) is the frequency of g among all rows. So f ranks
actions as Q does. The policy ascends f and imitates the data.
"""

from math import sqrt
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn import functional
from torchrl.objectives import hold_out_net

from torch_panda.learning.offline.base import (
    Actor,
    Batch,
    OfflineAgent,
    OfflineHyperparameters,
    ascend_and_imitate,
    log_prob,
    make_gelu_mlp,
)
from torch_panda.learning.spaces import Spaces

LATENT_SIZE = 128  # size of phi and psi, smaller than OGBench's


class CRL(OfflineAgent):
    """A contrastive critic f(s, a, g), and a policy pi(a | s, g) that ascends it."""

    # For its cube tasks, OGBench takes an alpha of 0.1 (noisy) or 3 (play).
    default_alpha: ClassVar = 0.1
    value_goal: ClassVar = "geometric"

    def __init__(self, spaces: Spaces, hp: OfflineHyperparameters) -> None:
        super().__init__(spaces, hp)
        state_size, goal_size = len(self.normalizer.state_columns), spaces.goal_size
        inputs = state_size + spaces.action_size
        self.phi, self.psi = (
            nn.ModuleList(make_gelu_mlp(size, LATENT_SIZE) for _ in range(2))
            for size in (inputs, goal_size)
        )
        self.actor = Actor(self.normalizer, spaces.action_size)
        self.assemble(self.actor)

    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """The losses of critic and policy."""
        b = Batch.from_tensordict(batch)
        phi, psi = self.encode(b.s, b.a, b.g)
        # Row i of the logits has (s, a) of row i, column j the goal of row j.
        logits = phi @ psi.mT / sqrt(LATENT_SIZE)  # (2, n, n)
        return {
            "critic_loss": contrastive_loss(logits),
            "actor_loss": self.actor_loss(b),
        }

    def encode(self, s: Tensor, a: Tensor, g: Tensor) -> tuple[Tensor, Tensor]:
        """phi(s, a) and psi(g) of both critics, (2, n, LATENT_SIZE) each."""
        x, y = self.normalizer.state(s), self.normalizer.goal(g)
        phi = torch.stack([net(x, a) for net in self.phi])
        psi = torch.stack([net(y) for net in self.psi])
        return phi, psi

    def actor_loss(self, b: Batch) -> Tensor:
        """Ascend f(s, pi(s, g), g) (section 4.3), and imitate as OGBench does."""
        mean = self.actor(b.s, b.g_actor)
        with hold_out_net(self.phi), hold_out_net(self.psi):
            phi, psi = self.encode(b.s, mean.clamp(-1.0, 1.0), b.g_actor)
            f = (phi * psi).sum(-1).amin(0) / sqrt(LATENT_SIZE)
        return ascend_and_imitate(f, log_prob(mean, b.a), self.alpha)


def contrastive_loss(logits: Tensor) -> Tensor:
    """NCE loss of section 4.2: tell the pairs on the diagonal from the others.

    Args:
        logits: f of every (s, a) with every goal of a batch, (..., n, n).
    """
    labels = torch.eye(logits.shape[-1], device=logits.device).expand_as(logits)
    return functional.binary_cross_entropy_with_logits(logits, labels)
