"""Quasimetric reinforcement learning, QRL (arXiv 2304.01203).

The cost of going from a state to a goal is a quasimetric: it satisfies the triangle
inequality, but need not be symmetric. QRL learns the largest quasimetric d in which
every observed step costs at most 1. This d is the optimal cost: by the triangle
inequality, d is at most the number of steps of any path. A Lagrange multiplier
lambda enforces the bound on steps, and QRL learns lambda together with d. The network
that represents d is an interval quasimetric embedding, IQE (arXiv 2211.15120).

With ``actor_loss="descend"``, the paper's policy descends d through a learned model of
the dynamics. This model needs more gradient steps than d. So the default is "imitate":
the policy imitates actions in proportion to exp(alpha * progress), as with OGBench's
option "awr".

The paper's goals are states. Here a goal is a part of a state, so goals have an encoder
of their own, and a step from each state to the goal that it achieves costs 0.
"""

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn import functional
from torchrl.objectives import hold_out_net

from torch_panda.learning.limits import Positive, Weight
from torch_panda.learning.offline.base import (
    Actor,
    Batch,
    OfflineAgent,
    OfflineHyperparameters,
    ascend_and_imitate,
    log_prob,
    make_gelu_mlp,
    weighted_regression,
)
from torch_panda.learning.spaces import Spaces

INTERVALS = 8  # intervals in each component of the quasimetric
# As in the paper's code: root mean square by which the cost of a step may exceed 1, and
# the learning rate of lambda.
EPSILON = 0.25
LAMBDA_LEARNING_RATE = 0.01
# Pairs are pushed apart by softplus(OFFSET - d, BETA): with slope 1 far below OFFSET,
# and hardly beyond it. OFFSET should exceed most costs. Most tasks here have episodes
# of 50 steps (Stack has 100).
OFFSET, BETA = 50.0, 0.1


@dataclass
class QRLHyperparameters(OfflineHyperparameters):
    """Hyperparameters of QRL.

    `imitation` is OGBench's alpha, with its value for cube tasks and play data.
    `num_components` is half of OGBench's. For noisy data, OGBench has an alpha of 0.03.
    With this value, our policy is too fast at the goal and leaves it again. A probable
    reason is that the policy's loss divides costs by their mean. Our tasks take fewer
    steps, so the mean is smaller, and one saved step weighs more against imitation.
    """

    algo: Literal["qrl"] = "qrl"
    """algorithm"""
    actor_loss: Literal["imitate", "descend"] = "imitate"
    """imitate actions that progress towards the goal ("imitate"), or descend the costs
    through learned dynamics (the paper's, "descend")"""
    alpha: Weight = 10.0
    """inverse temperature of the weights of actions for "imitate\""""
    imitation: Weight = 0.3
    """weight of the imitation in the policy's loss for "descend\""""
    num_components: Positive = 32
    """number of components of the quasimetric"""


class QRL(OfflineAgent):
    """A quasimetric d(s, g), and a policy pi(a | s, g) that follows it.

    If the policy descends d, there is also a model of latent dynamics.
    """

    Hyperparameters: ClassVar = QRLHyperparameters
    value_goal: ClassVar = "random"
    hp: QRLHyperparameters

    def __init__(self, spaces: Spaces, hp: QRLHyperparameters) -> None:
        super().__init__(spaces, hp)
        state_size, action_size = len(self.normalizer.state_columns), spaces.action_size
        latent_size = INTERVALS * hp.num_components
        self.state_encoder = make_gelu_mlp(state_size, latent_size, hp.hidden_size)
        self.goal_encoder = make_gelu_mlp(spaces.goal_size, latent_size, hp.hidden_size)
        self.quasimetric = IQE()
        if hp.actor_loss == "descend":
            self.dynamics = make_gelu_mlp(
                latent_size + action_size, latent_size, hp.hidden_size
            )
        self.actor = Actor(self.normalizer, action_size, hp.hidden_size)
        self.assemble(self.actor)
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

    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """The losses of quasimetric, multiplier, dynamics and policy."""
        b = Batch.from_tensordict(batch)
        z, z_next = self.encode_state(b.s), self.encode_state(b.s_next)
        far = self.quasimetric(z, self.encode_goal(b.g))
        # Section 3.2: push states and random goals apart, far pairs less.
        push = functional.softplus(OFFSET - far, beta=BETA).mean()
        # Eq. 10: steps cost at most 1. Reaching the achieved goal costs 0.
        too_far = (self.quasimetric(z, z_next) - 1).relu().square().mean()
        achieved = self.quasimetric(z_next, self.encode_goal(b.achieved))
        violation = too_far + achieved.square().mean()
        multiplier = self.log_lambda.exp()
        losses = {
            "value_loss": push + multiplier.detach() * violation,
            "multiplier_loss": multiplier * (EPSILON**2 - violation.detach()),
        }
        if self.hp.actor_loss == "imitate":
            return {**losses, "actor_loss": self.imitation_loss(b)}
        losses["dynamics_loss"] = self.dynamics_loss(z, b.a, z_next)
        return {**losses, "actor_loss": self.descent_loss(b)}

    def imitation_loss(self, b: Batch) -> Tensor:
        """Weighted imitation. The advantage is the progress d(s, g) - d(s', g)."""
        with torch.no_grad():
            goal = self.encode_goal(b.g_actor)
            before = self.quasimetric(self.encode_state(b.s), goal)
            after = self.quasimetric(self.encode_state(b.s_next), goal)
        log_probs = log_prob(self.actor(b.s, b.g_actor), b.a)
        return weighted_regression(log_probs, before - after, self.hp.alpha)

    def dynamics_loss(self, z: Tensor, a: Tensor, z_next: Tensor) -> Tensor:
        """Distances from z + T(z, a) to z' and back (section 3.4).

        This loss also trains the encoder and the quasimetric.
        """
        predicted = z + self.dynamics(z, a)
        distance = self.quasimetric(predicted, z_next)
        return (distance + self.quasimetric(z_next, predicted)).mean() / 2

    def descent_loss(self, b: Batch) -> Tensor:
        """Descend d(z + T(z, pi(s, g)), g) (section 3.4), and imitate as OGBench."""
        mean = self.actor(b.s, b.g_actor)
        with torch.no_grad():
            z, goal = self.encode_state(b.s), self.encode_goal(b.g_actor)
        with hold_out_net(self.dynamics), hold_out_net(self.quasimetric):
            predicted = z + self.dynamics(z, mean.clamp(-1.0, 1.0))
            q = -self.quasimetric(predicted, goal)
        return ascend_and_imitate(q, log_prob(mean, b.a), self.hp.imitation)


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
