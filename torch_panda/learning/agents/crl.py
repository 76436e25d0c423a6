"""Contrastive reinforcement learning, CRL (arXiv 2206.07568), which needs no rewards.

The critic f(s, a, g) learns which goals g an episode achieves after an action a in a
state s. Its positive goals are achieved k steps after (s, a), where k is drawn with a
probability in proportion to gamma**k. Its negative goals are those of other rows. At
its optimum, f is log(p(g | s, a) / p(g)) plus a constant. Here p(g | s, a) is the
discounted probability of reaching g after (s, a), and p(g) is the frequency of g in the
batches. So f ranks actions as Q does, and the actor ascends f.

`CRL` explores. Its f and the loss of its critic are those of JaxGCRL (arXiv
2408.11052). `OfflineCRL` learns from a data set, like OGBench's CRL. With its f and its
loss in `CRL`, Reach had 39 % success after 3,200 steps instead of 100 % (one seed
each).
"""

from math import sqrt
from typing import ClassVar

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.nn import functional
from torchrl.objectives import hold_out_net

from torch_panda.learning.agents.base import Agent
from torch_panda.learning.agents.batch import Batch
from torch_panda.learning.agents.ddpg import action_penalty
from torch_panda.learning.agents.exploration import make_noise
from torch_panda.learning.agents.hyperparameters import Hyperparameters
from torch_panda.learning.agents.networks import freeze, make_mlp
from torch_panda.learning.agents.offline_losses import (
    OGBENCH_RATES,
    ascend_and_imitate,
    log_prob,
    make_mean_policy,
)
from torch_panda.learning.environments.spaces import Spaces

LATENT_SIZE = 64  # size of phi and psi
LOGSUMEXP_WEIGHT = 0.1  # JaxGCRL's weight of the penalty in the critic's loss
OFFLINE_LATENT_SIZE = 128  # size of phi and psi in `OfflineCRL`, smaller than OGBench's


class CRL(Agent):
    """A critic f(s, a, g) = -|phi(s, a) - psi(g)|, and an actor that ascends it.

    The replay buffer gives every sampled transition a positive goal; see `make_buffer`
    with her="geometric".
    """

    def __init__(self, spaces: Spaces, hp: Hyperparameters) -> None:
        super().__init__(spaces, hp)
        action_size = spaces.action_size
        actor = make_mlp(self.state_size, action_size, hp.network)
        self.actor = nn.Sequential(actor, nn.Tanh())
        inputs = len(self.normalizer.state_columns) + action_size
        self.phi = make_mlp(inputs, LATENT_SIZE, hp.network)
        self.psi = make_mlp(spaces.goal_size, LATENT_SIZE, hp.network)
        self.assemble(
            TensorDictModule(self.actor, ["normalized"], ["action"]),
            make_noise(spaces, hp),
        )

    def losses(self, b: Batch) -> dict[str, Tensor]:
        """The losses of critic and actor. Rewards and next states are not used."""
        # The augmentation "mirror-shift" shifts half of the rows, each by an offset of
        # its own. The critic can tell a shifted goal from the others by its place. This
        # changes p(g), but for all actions alike, so the best action stays the same.
        s = self.normalizer(b.s, b.g)[:, self.normalizer.state_columns]
        phi, psi = self.phi(s, b.a), self.psi(self.normalizer.goal(b.g))
        critic_loss = symmetric_loss(-distances(phi, psi))

        # Half of the actor's goals belong to other rows, as in the published code of
        # arXiv 2206.07568. The cube rarely moves, so most rows' own goals are achieved
        # before the step.
        other = torch.arange(len(s), device=s.device)
        other[::2] = other[::2].roll(1)
        before_tanh = self.actor[0](self.normalizer(b.s, b.g[other]))
        action = before_tanh.tanh()
        with hold_out_net(self.phi):
            f = -(self.phi(s, action) - psi.detach()[other]).norm(dim=-1)
        penalty = action_penalty(before_tanh, action, self.hp.action_l2)
        return {"critic_loss": critic_loss, "actor_loss": penalty - f.mean()}


def distances(x: Tensor, y: Tensor) -> Tensor:
    """Distances of all rows of x and y, (n, size) each: (n, n).

    By default, `torch.cdist` multiplies matrices, which may round small distances to 0.
    """
    return torch.cdist(x, y, compute_mode="donot_use_mm_for_euclid_dist")


def symmetric_loss(logits: Tensor) -> Tensor:
    """Symmetric InfoNCE loss with JaxGCRL's penalty on log-sum-exp, a scalar.

    Args:
        logits: f of every (s, a) with every goal of a batch, (n, n). The goals on the
            diagonal were achieved after (s, a).
    """
    by_row, by_column = logits.logsumexp(1), logits.logsumexp(0)
    loss = by_row + by_column - 2 * logits.diagonal()
    return (loss + LOGSUMEXP_WEIGHT * by_row.square()).mean()


class OfflineCRL(Agent):
    """Two critics f(s, a, g) = phi(s, a)^T psi(g) / sqrt(size of phi), and a policy.

    The policy pi(a | s, g) ascends the smaller f and imitates the data.
    """

    learning_rate, tau = OGBENCH_RATES
    # For its cube tasks, OGBench takes an alpha of 0.1 (noisy) or 3 (play).
    default_alpha: ClassVar = 0.1
    value_goal: ClassVar = "geometric"

    def __init__(self, spaces: Spaces, hp: Hyperparameters) -> None:
        super().__init__(spaces, hp)
        state_size, goal_size = len(self.normalizer.state_columns), spaces.goal_size
        inputs = state_size + spaces.action_size
        self.phi, self.psi = (
            nn.ModuleList(
                make_mlp(size, OFFLINE_LATENT_SIZE, hp.network) for _ in range(2)
            )
            for size in (inputs, goal_size)
        )
        self.actor = make_mlp(self.state_size, spaces.action_size, hp.network)
        self.assemble(make_mean_policy(self.actor))

    def losses(self, b: Batch) -> dict[str, Tensor]:
        """The losses of critics and policy."""
        s, g = self.normalizer.state(b.s), self.normalizer.goal(b.g)
        phi = torch.stack([net(s, b.a) for net in self.phi])
        psi = torch.stack([net(g) for net in self.psi])
        # Row i of the logits has (s, a) of row i, column j the goal of row j.
        logits = phi @ psi.mT / sqrt(OFFLINE_LATENT_SIZE)  # (2, n, n)
        return {
            "critic_loss": binary_loss(logits),
            "actor_loss": self.actor_loss(b, s),
        }

    def actor_loss(self, b: Batch, s: Tensor) -> Tensor:
        """Ascend f(s, pi(s, g), g) (section 4.3), and imitate as OGBench does."""
        mean = self.actor(self.normalizer(b.s, b.g_actor))
        action, g = mean.clamp(-1.0, 1.0), self.normalizer.goal(b.g_actor)
        phi = torch.stack([freeze(net)(s, action) for net in self.phi])
        with torch.no_grad():
            psi = torch.stack([net(g) for net in self.psi])
        f = (phi * psi).sum(-1).amin(0) / sqrt(OFFLINE_LATENT_SIZE)
        return ascend_and_imitate(f, log_prob(mean, b.a), self.alpha)


def binary_loss(logits: Tensor) -> Tensor:
    """NCE loss of section 4.2: tell the pairs on the diagonal from the others.

    Args:
        logits: f of every (s, a) with every goal of a batch, (..., n, n).
    """
    labels = torch.eye(logits.shape[-1], device=logits.device).expand_as(logits)
    return functional.binary_cross_entropy_with_logits(logits, labels)
