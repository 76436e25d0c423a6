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

from math import sqrt
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

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
from torch_panda.learning.offline_data import OfflineData
from torch_panda.transforms.strategies import StrategyOption

REP_SIZE = 10  # size of the representation of a waypoint


class HIQL(Agent):
    """Values of waypoints and goals, and a policy of each level.

    The defaults are OGBench's for its cube tasks. Both levels have the same alpha.

    Args:
        spaces: Sizes and layout of observations, goals and actions.
        hp: Hyperparameters.
        expectile: Expectile of the values, tau in the paper.
        subgoal_steps: Number k of steps from a state to its waypoint, OGBench's
            subgoal.
    """

    learning_rate, tau = OGBENCH_RATES
    default_alpha: ClassVar = 3.0

    def __init__(
        self,
        spaces: Spaces,
        hp: Hyperparameters,
        *,
        expectile: float = 0.7,
        subgoal_steps: int = 10,
    ) -> None:
        super().__init__(spaces, hp)
        self.expectile, self.subgoal_steps = expectile, subgoal_steps
        # s below is the part of the inputs that does not depend on the goal.
        columns = self.normalizer.state_columns
        state_size = len(columns)
        # phi(s, w), the values of waypoints and of goals, and targets of all three.
        self.phi = make_mlp(2 * state_size, REP_SIZE, hp.network)
        self.waypoint_value = Ensemble(state_size + REP_SIZE, hp.network)
        self.goal_value = Ensemble(self.state_size, hp.network)
        self.online = nn.ModuleDict(
            {
                "phi": self.phi,
                "waypoint_value": self.waypoint_value,
                "goal_value": self.goal_value,
            }
        )
        self.target = self.make_target(self.online)
        # pi^h(z | s, g) and pi^l(a | s, z).
        self.high_actor = make_mlp(self.state_size, REP_SIZE, hp.network)
        self.low_actor = make_mlp(state_size + REP_SIZE, spaces.action_size, hp.network)
        actor = HierarchicalActor(self.high_actor, self.low_actor, columns)
        self.assemble(make_mean_policy(actor))

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
        waypoint_row = t + self.subgoal_steps - 1
        observation = data.rows["next", "observation"]
        batch["high_waypoint"] = observation[waypoint_row.minimum(goal_row)]
        batch["low_waypoint"] = observation[waypoint_row.minimum(data.last[t].cpu())]
        batch["value_waypoint"] = observation[value_row]
        batch["reaches_waypoint"] = value_row == t
        return batch

    def losses(self, b: Batch) -> dict[str, Tensor]:
        """The losses of both values and both policies."""
        s, s_next = self.normalizer.state(b.s), self.normalizer.state(b.s_next)
        w, reaches_w = b.source["value_waypoint"], b.source["reaches_waypoint"]
        high_w, low_w = b.source["high_waypoint"], b.source["low_waypoint"]
        return {
            "goal_value_loss": self.goal_value_loss(b),
            "waypoint_value_loss": self.waypoint_value_loss(s, s_next, w, reaches_w),
            "high_actor_loss": self.high_actor_loss(b, s, high_w),
            "low_actor_loss": self.low_actor_loss(b.a, s, s_next, low_w),
        }

    def represent(self, phi: nn.Module, s: Tensor, w: Tensor) -> Tensor:
        """phi(s, w), scaled to the Euclidean norm sqrt(REP_SIZE), (n, REP_SIZE)."""
        return normalize_length(phi(s, self.normalizer.state(w)))

    def goal_value_loss(self, b: Batch) -> Tensor:
        """Action-free expectile regression of V(s, g) (eq. 4)."""
        value, target = self.goal_value, self.target["goal_value"]
        x, x_next = self.normalizer(b.s, b.g), self.normalizer(b.s_next, b.g)
        with torch.no_grad():
            q = b.r + self.gamma * ~b.ends * target(x_next)  # (2, n)
            v_target = target(x)
        return ensemble_loss(q, value(x), v_target, self.expectile)

    def waypoint_value_loss(
        self, s: Tensor, s_next: Tensor, w: Tensor, reaches_w: Tensor
    ) -> Tensor:
        """Expectile regression of V(s, phi(s, w)), which trains phi (section 5.2)."""
        phi, value = self.target["phi"], self.target["waypoint_value"]
        with torch.no_grad():
            v_next = value(s_next, self.represent(phi, s_next, w))
            # -1 per step, until s' is the waypoint: then 0, and the return ends.
            q = ~reaches_w * (self.gamma * v_next - 1)
            v_target = value(s, self.represent(phi, s, w))
        v = self.waypoint_value(s, self.represent(self.phi, s, w))
        return ensemble_loss(q, v, v_target, self.expectile)

    def high_actor_loss(self, b: Batch, s: Tensor, w: Tensor) -> Tensor:
        """Weighted imitation of waypoints, A = V(w, g) - V(s, g) (eq. 6)."""
        x = self.normalizer(b.s, b.g_actor)
        with torch.no_grad():
            v = self.goal_value(x).mean(0)
            v_later = self.goal_value(self.normalizer(w, b.g_actor)).mean(0)
            z = self.represent(self.phi, s, w)
        log_probs = log_prob(self.high_actor(x), z)
        return weighted_regression(log_probs, v_later - v, self.alpha)

    def low_actor_loss(self, a: Tensor, s: Tensor, s_next: Tensor, w: Tensor) -> Tensor:
        """Weighted imitation of actions, A = V(s', w) - V(s, w) (eq. 7)."""
        with torch.no_grad():
            z = self.represent(self.phi, s, w)
            v = self.waypoint_value(s, z).mean(0)
            z_next = self.represent(self.phi, s_next, w)
            v_next = self.waypoint_value(s_next, z_next).mean(0)
        log_probs = log_prob(self.low_actor(s, z), a)
        return weighted_regression(log_probs, v_next - v, self.alpha)


class HierarchicalActor(nn.Module):
    """Acts towards the waypoint whose representation the high level outputs.

    Args:
        high_actor: Network from inputs with goals to a waypoint's representation.
        low_actor: Network from inputs without goals and representation to action.
        columns: Columns of the inputs that do not depend on the goal, int64.
    """

    columns: Tensor

    def __init__(
        self, high_actor: nn.Module, low_actor: nn.Module, columns: Tensor
    ) -> None:
        super().__init__()
        self.high_actor, self.low_actor = high_actor, low_actor
        self.register_buffer("columns", columns, persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """The mean action, (..., action size)."""
        z = normalize_length(self.high_actor(x))
        return self.low_actor(x[..., self.columns], z)


def normalize_length(z: Tensor) -> Tensor:
    """Scale vectors (..., n) to the Euclidean norm sqrt(n)."""
    return z * (sqrt(z.shape[-1]) / z.norm(dim=-1, keepdim=True).clamp(min=1e-6))
