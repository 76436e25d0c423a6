"""Quasimetric reinforcement learning, QRL (arXiv 2304.01203).

The cost of going from a state to a goal is a quasimetric: it satisfies the triangle
inequality, but need not be symmetric. QRL learns the largest quasimetric d in which
every observed step costs at most 1. This d is the optimal cost: by the triangle
inequality, d is at most the number of steps of any path. A Lagrange multiplier
lambda enforces the bound on steps, and QRL learns lambda together with d. The network
that represents d is an interval quasimetric embedding, IQE (arXiv 2211.15120).

The paper's policy descends d through a learned model of the dynamics. This model needs
more gradient steps than d: after 2,000 steps on Push, it had learned nothing. So here
the policy imitates actions in proportion to exp(alpha * progress), as with OGBench's
option "awr".

The paper's goals are states. Here a goal is a part of a state, so goals have an encoder
of their own, and a step from each state to the goal that it achieves costs 0.
"""

from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from torch_panda.learning.agents.base import Agent
from torch_panda.learning.agents.batch import Batch
from torch_panda.learning.agents.hyperparameters import Hyperparameters
from torch_panda.learning.agents.networks import make_mlp
from torch_panda.learning.agents.offline_losses import (
    OGBENCH_RATES,
    log_prob,
    make_mean_policy,
    weighted_regression,
)
from torch_panda.learning.environments.spaces import Spaces

INTERVALS = 8  # intervals in each component of the quasimetric
# As in the paper's code: root mean square by which the cost of a step may exceed 1, and
# the learning rate of lambda.
EPSILON = 0.25
LAMBDA_LEARNING_RATE = 0.01
# Pairs are pushed apart by softplus(OFFSET - d, BETA): with slope 1 far below OFFSET,
# and hardly beyond it. OFFSET should exceed most costs. Most tasks here have episodes
# of 50 steps (Stack has 100).
OFFSET, BETA = 50.0, 0.1


class QRL(Agent):
    """A quasimetric d(s, g), and a policy pi(a | s, g) that follows it.

    Args:
        spaces: Sizes and layout of observations, goals and actions.
        hp: Hyperparameters.
        num_components: Number of components of the quasimetric, by default half of
            OGBench's.
    """

    learning_rate, tau = OGBENCH_RATES
    default_alpha: ClassVar = 10.0  # OGBench's for cube tasks and play data
    value_goal: ClassVar = "random"

    def __init__(
        self, spaces: Spaces, hp: Hyperparameters, *, num_components: int = 32
    ) -> None:
        super().__init__(spaces, hp)
        state_size = len(self.normalizer.state_columns)
        latent_size = INTERVALS * num_components
        self.state_encoder = make_mlp(state_size, latent_size, hp.network)
        self.goal_encoder = make_mlp(spaces.goal_size, latent_size, hp.network)
        self.quasimetric = IQE()
        self.actor = make_mlp(self.state_size, spaces.action_size, hp.network)
        self.assemble(make_mean_policy(self.actor))
        self.log_lambda = nn.Parameter(torch.zeros(()))
        self.optimizer.add_param_group(
            {"params": [self.log_lambda], "lr": LAMBDA_LEARNING_RATE}
        )

    def encode_state(self, s: Tensor) -> Tensor:
        """Latent of observations, (n, latent size)."""
        return self.state_encoder(self.normalizer.state(s))

    def encode_goal(self, g: Tensor) -> Tensor:
        """Latent of goals, (n, latent size)."""
        return self.goal_encoder(self.normalizer.goal(g))

    def losses(self, b: Batch) -> dict[str, Tensor]:
        """The losses of quasimetric, multiplier and policy."""
        z, z_next = self.encode_state(b.s), self.encode_state(b.s_next)
        far = self.quasimetric(z, self.encode_goal(b.g))
        # Section 3.2: push states and random goals apart, far pairs less.
        push = functional.softplus(OFFSET - far, beta=BETA).mean()
        # Eq. 10: steps cost at most 1. Reaching the achieved goal costs 0.
        too_far = (self.quasimetric(z, z_next) - 1).relu().square().mean()
        goal = self.encode_goal(b.source["next", "achieved_goal"])
        achieved = self.quasimetric(z_next, goal)
        violation = too_far + achieved.square().mean()
        multiplier = self.log_lambda.exp()
        return {
            "value_loss": push + multiplier.detach() * violation,
            "multiplier_loss": multiplier * (EPSILON**2 - violation.detach()),
            "actor_loss": self.actor_loss(b),
        }

    def actor_loss(self, b: Batch) -> Tensor:
        """Weighted imitation. The advantage is the progress d(s, g) - d(s', g)."""
        with torch.no_grad():
            goal = self.encode_goal(b.g_actor)
            before = self.quasimetric(self.encode_state(b.s), goal)
            after = self.quasimetric(self.encode_state(b.s_next), goal)
        log_probs = log_prob(self.actor(self.normalizer(b.s, b.g_actor)), b.a)
        return weighted_regression(log_probs, before - after, self.alpha)


class IQE(nn.Module):
    """Interval quasimetric embedding (arXiv 2211.15120, sections 3 and 4).

    A component of d(x, y) is the length of the union of the intervals [x_j, max(x_j,
    y_j)]. Maximum and mean over the components are mixed with a learned ratio.
    """

    def __init__(self) -> None:
        super().__init__()
        self.mixture = nn.Parameter(torch.zeros(()))

    def forward(self, x: Tensor, y: Tensor) -> Tensor:
        """Distances from x to y, (...).

        The arguments have the shape (..., components * INTERVALS).
        """
        x, y = (values.unflatten(-1, (-1, INTERVALS)) for values in (x, y))
        # In the order of their starts, each interval adds to the union the part beyond
        # the largest end of the intervals before it.
        start, order = x.sort(dim=-1)
        end = torch.maximum(x, y).gather(-1, order)
        covered = torch.cat((start[..., :1], end.cummax(-1).values[..., :-1]), -1)
        components = (end - torch.maximum(start, covered)).relu().sum(-1)
        ratio = self.mixture.sigmoid()
        return ratio * components.amax(-1) + (1 - ratio) * components.mean(-1)
