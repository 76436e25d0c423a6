"""Hierarchical implicit Q-learning, HIQL (arXiv 2307.11949).

The high-level policy outputs z = phi(s, w), the representation of a waypoint w that is
to be reached k steps later. The low-level policy acts towards the waypoint. Both
imitate the data in proportion to exp(alpha * advantage). The advantages come from state
values without Q, as in `gcivl.py`.

The paper's goals are states, so one value function judges waypoints and goals. Here a
goal is a part of a state, such as the position of a cube. While the hand approaches the
cube, this position stays the same, so all waypoints of the approach would be equal.
Therefore a waypoint w is a whole observation, and there are two value functions: V(s,
phi(s, w)) of waypoints, which trains phi, and V(s, g) of goals.
"""

import copy
from dataclasses import dataclass
from math import sqrt
from typing import ClassVar, Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from torch_panda.learning.limits import Positive, Ratio, Weight
from torch_panda.learning.normalizer import Normalizer
from torch_panda.learning.offline.base import (
    Actor,
    Batch,
    Ensemble,
    OfflineAgent,
    OfflineHyperparameters,
    ensemble_loss,
    log_prob,
    make_gelu_mlp,
    move_towards,
    weighted_regression,
)
from torch_panda.learning.offline.data import OfflineData
from torch_panda.learning.spaces import Spaces
from torch_panda.transforms.strategies import StrategyOption


@dataclass
class HIQLHyperparameters(OfflineHyperparameters):
    """Hyperparameters of HIQL, by default OGBench's for its cube tasks."""

    algo: Literal["hiql"] = "hiql"
    """algorithm"""
    expectile: Ratio = 0.7
    """expectile of the values, tau in the paper"""
    high_alpha: Weight = 3.0
    """inverse temperature of the weights of imitated waypoints"""
    low_alpha: Weight = 3.0
    """inverse temperature of the weights of imitated actions"""
    subgoal_steps: Positive = 10
    """number k of steps from a state to its waypoint, OGBench's subgoal"""
    rep_dim: Positive = 10
    """size of the representation of a waypoint"""


class HIQL(OfflineAgent):
    """Values of waypoints and goals, and a policy of each level."""

    Hyperparameters: ClassVar = HIQLHyperparameters
    hp: HIQLHyperparameters

    def __init__(self, spaces: Spaces, hp: HIQLHyperparameters) -> None:
        super().__init__(spaces, hp)
        inputs, hidden_size = len(self.normalizer.mean), hp.hidden_size
        state_size = len(self.normalizer.state_columns)
        # phi(s, w), the values of waypoints and of goals, and targets of all three.
        self.phi = make_gelu_mlp(2 * state_size, hp.rep_dim, hidden_size)
        self.waypoint_value = Ensemble(state_size + hp.rep_dim, hidden_size)
        self.goal_value = Ensemble(inputs, hidden_size)
        self.online = nn.ModuleDict(
            {
                "phi": self.phi,
                "waypoint_value": self.waypoint_value,
                "goal_value": self.goal_value,
            }
        )
        self.target = copy.deepcopy(self.online).requires_grad_(False)
        # pi^h(z | s, g) and pi^l(a | s, z).
        self.high_actor = Actor(self.normalizer, hp.rep_dim, hidden_size)
        self.low_actor = make_gelu_mlp(
            state_size + hp.rep_dim, spaces.action_size, hidden_size
        )
        self.assemble(
            HierarchicalActor(self.normalizer, self.high_actor, self.low_actor)
        )

    @property
    def goal_strategies(self) -> dict[str, StrategyOption]:
        """The strategies of goals, and of the waypoints of V(s, phi(s, w))."""
        return {**super().goal_strategies, "waypoint": self.value_goal}

    def extend(self, batch: TensorDictBase, data: OfflineData) -> TensorDictBase:
        """Add a waypoint for each of three losses.

        The three losses are those of the high-level policy, the low-level policy and
        the values of waypoints. The waypoint of the low level does not lie beyond the
        end of the episode. The waypoint of the high level does not lie beyond the goal
        of the policy loss.
        """
        t, goal_row, value_row = (
            batch[key].cpu() for key in ("index", "actor_goal_row", "waypoint_row")
        )
        # Row t holds a state s and the next state s', so the state k steps after s is
        # s' of row t + k - 1.
        waypoint_row = t + self.hp.subgoal_steps - 1
        observation = data.rows["next", "observation"]
        batch["high_waypoint"] = observation[waypoint_row.minimum(goal_row)]
        batch["low_waypoint"] = observation[waypoint_row.minimum(data.last[t].cpu())]
        batch["value_waypoint"] = observation[value_row]
        batch["reaches_waypoint"] = value_row == t
        return batch

    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """The losses of both values and both policies."""
        b = Batch.from_tensordict(batch)
        s, s_next = self.normalizer.state(b.s), self.normalizer.state(b.s_next)
        w, reaches_w = batch["value_waypoint"], batch["reaches_waypoint"]
        high_w, low_w = batch["high_waypoint"], batch["low_waypoint"]
        return {
            "goal_value_loss": self.goal_value_loss(b),
            "waypoint_value_loss": self.waypoint_value_loss(s, s_next, w, reaches_w),
            "high_actor_loss": self.high_actor_loss(b, s, high_w),
            "low_actor_loss": self.low_actor_loss(b.a, s, s_next, low_w),
        }

    def represent(self, phi: nn.Module, s: Tensor, w: Tensor) -> Tensor:
        """phi(s, w), scaled to the Euclidean norm sqrt(rep_dim), (n, rep_dim)."""
        return normalize_length(phi(s, self.normalizer.state(w)))

    def goal_value_loss(self, b: Batch) -> Tensor:
        """Action-free expectile regression of V(s, g) (eq. 4)."""
        value, target = self.goal_value, self.target["goal_value"]
        x, x_next = self.normalizer(b.s, b.g), self.normalizer(b.s_next, b.g)
        with torch.no_grad():
            q = b.r + self.hp.discount * b.mask * target(x_next)  # (2, n)
            v_target = target(x)
        return ensemble_loss(q, value(x), v_target, self.hp.expectile)

    def waypoint_value_loss(
        self, s: Tensor, s_next: Tensor, w: Tensor, reaches_w: Tensor
    ) -> Tensor:
        """Expectile regression of V(s, phi(s, w)), which trains phi (section 5.2)."""
        phi, value = self.target["phi"], self.target["waypoint_value"]
        with torch.no_grad():
            v_next = value(s_next, self.represent(phi, s_next, w))
            # -1 per step, until s' is the waypoint: then 0, and the return ends.
            q = ~reaches_w * (self.hp.discount * v_next - 1)
            v_target = value(s, self.represent(phi, s, w))
        v = self.waypoint_value(s, self.represent(self.phi, s, w))
        return ensemble_loss(q, v, v_target, self.hp.expectile)

    def high_actor_loss(self, b: Batch, s: Tensor, w: Tensor) -> Tensor:
        """Weighted imitation of waypoints, A = V(w, g) - V(s, g) (eq. 6)."""
        with torch.no_grad():
            v = self.goal_value(self.normalizer(b.s, b.g_actor)).mean(0)
            v_later = self.goal_value(self.normalizer(w, b.g_actor)).mean(0)
            z = self.represent(self.phi, s, w)
        log_probs = log_prob(self.high_actor(b.s, b.g_actor), z)
        return weighted_regression(log_probs, v_later - v, self.hp.high_alpha)

    def low_actor_loss(self, a: Tensor, s: Tensor, s_next: Tensor, w: Tensor) -> Tensor:
        """Weighted imitation of actions, A = V(s', w) - V(s, w) (eq. 7)."""
        with torch.no_grad():
            z = self.represent(self.phi, s, w)
            v = self.waypoint_value(s, z).mean(0)
            z_next = self.represent(self.phi, s_next, w)
            v_next = self.waypoint_value(s_next, z_next).mean(0)
        log_probs = log_prob(self.low_actor(s, z), a)
        return weighted_regression(log_probs, v_next - v, self.hp.low_alpha)

    def move_targets(self) -> None:
        """Move the target networks of phi and of both values towards the networks."""
        move_towards(self.target, self.online, self.hp.tau)


class HierarchicalActor(nn.Module):
    """Acts towards the waypoint whose representation the high level outputs.

    Args:
        normalizer: Standardises observations.
        high_actor: Module from observation and goal to a waypoint's representation.
        low_actor: Network from standardised observation and representation to action.
    """

    def __init__(
        self, normalizer: Normalizer, high_actor: Actor, low_actor: nn.Module
    ) -> None:
        super().__init__()
        self.normalizer = normalizer
        self.high_actor, self.low_actor = high_actor, low_actor

    def forward(self, s: Tensor, g: Tensor) -> Tensor:
        """The mean action, (..., action size)."""
        z = normalize_length(self.high_actor(s, g))
        return self.low_actor(self.normalizer.state(s), z)


def normalize_length(z: Tensor) -> Tensor:
    """Scale vectors (..., n) to the Euclidean norm sqrt(n)."""
    return z * (sqrt(z.shape[-1]) / z.norm(dim=-1, keepdim=True).clamp(min=1e-6))
