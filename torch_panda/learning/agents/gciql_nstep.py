"""GCIQL with n-step returns, from which recent offline agents start.

With returns of one step, the value of a goal that is k steps away needs k updates of Q,
one after another, and each of them adds its error. Returns of n steps need a k / n-th
of them. In long tasks this helps more than larger networks and more data (arXiv
2506.04168), and decoupled Q-chunking starts from it (arXiv 2512.10926).

The price: the actions between the first and the last step of a return are those of the
data, so Q learns what the data achieve there, and not what better actions would.
"""

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torch_panda.learning.agents.batch import Batch
from torch_panda.learning.agents.gciql import GCIQL
from torch_panda.learning.agents.hyperparameters import Hyperparameters
from torch_panda.learning.environments.spaces import Spaces
from torch_panda.learning.offline_data import OfflineData


class NStepGCIQL(GCIQL):
    """GCIQL whose rows are transitions over up to n steps of one trajectory.

    The goal of a row is drawn for its first step, and holds for all of its steps. The
    row stops early in the first step that reaches this goal, and in the last step of
    the trajectory. So no step of another trajectory is used, also if the goal is that
    of another trajectory. As in a return of one step, there is no next value after a
    reached goal, but there is one after the end of a trajectory.

    Args:
        spaces: Sizes and layout of observations, goals and actions.
        hp: Hyperparameters.
        expectile: Expectile of the values, tau in IQL's paper.
        num_steps: Largest number n of steps.
    """

    def __init__(
        self,
        spaces: Spaces,
        hp: Hyperparameters,
        *,
        expectile: float = 0.9,
        num_steps: int = 10,
    ) -> None:
        super().__init__(spaces, hp, expectile=expectile)
        self.num_steps = num_steps

    def extend(self, batch: TensorDictBase, data: OfflineData) -> TensorDictBase:
        """Replace next observation, reward and end by those after up to n steps.

        The reward becomes the discounted sum of the rewards of the steps. The new entry
        ``discount`` is the weight of the next value.
        """
        first = batch["index"].to(data.last.device)
        last, ahead = data.last[first], torch.arange(self.num_steps).to(first)
        rows = first.unsqueeze(-1) + ahead  # (n, num_steps)
        within = rows.minimum(last.unsqueeze(-1))
        achieved = data.rows["next", "achieved_goal"][within]
        goal = batch["value_goal"].unsqueeze(1).expand_as(achieved)
        reached = data.is_success(achieved, goal).squeeze(-1)
        # A step is taken if no step before it reached the goal or ended the trajectory.
        stops = reached | (rows == last.unsqueeze(-1))
        taken = stops.cumsum(-1) - stops.long() == 0
        steps = taken.sum(-1)
        rewards = (taken & ~reached) * -(self.gamma**ahead)
        batch["next", "observation"] = data.rows["next", "observation"][
            first + steps - 1
        ]
        batch["next", "reward"] = rewards.sum(-1, keepdim=True)
        batch["next", "terminated"] = (taken & reached).any(-1, keepdim=True)
        batch["discount"] = self.gamma**steps
        return batch

    def discount(self, b: Batch) -> Tensor:
        """Discount of the next value, (n,)."""
        return b.source["discount"]
