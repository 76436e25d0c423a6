"""A data set in memory, whose sampled transitions get goals."""

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer, TensorStorage

from torch_panda.envs import RobotTaskEnv
from torch_panda.transforms import GoalSampler
from torch_panda.transforms.strategies import StrategyOption


class OfflineData:
    """The transitions of whole episodes, and a buffer that samples them.

    The rewards of the data are replaced: a sampled transition has the reward 0 if it
    reaches its value goal, and -1 if not. Reaching the goal ends the return. All draws
    come from torch's global random generator, whose state a run saves.

    Args:
        data: Transitions (n,) in the order of time, with ``observation``, ``action``,
            ``desired_goal``, ``("collector", "traj_ids")``, and under ``next``
            ``observation``, ``achieved_goal``, ``desired_goal``, ``reward``,
            ``terminated`` and ``done``. The rows of an episode are consecutive.
        env: Environment of the task.
        goal_strategies: Strategy for each key under which goals are drawn. The first
            key holds the value goals.
        discount: Discount of the strategy "geometric".

    Attributes:
        rows: The transitions, (n,).
        last: Index of the last transition of each transition's episode, (n,).
        is_success: Whether achieved goals reach desired goals, (..., goal size) each.
    """

    def __init__(
        self,
        data: TensorDictBase,
        env: RobotTaskEnv,
        goal_strategies: Mapping[str, StrategyOption],
        discount: float,
    ) -> None:
        self.is_success = env.is_success

        def reward(achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
            return self.is_success(achieved_goal, desired_goal).float() - 1.0

        # Number the episodes 0, 1, ... in the order of the rows. Episode i then ends in
        # row `ends.nonzero()[i]`.
        ids = data["collector", "traj_ids"]
        ends = torch.ones_like(ids, dtype=torch.bool)
        ends[:-1] = ids[1:] != ids[:-1]
        data = data.copy()  # so that the caller's data stay as they are
        data["collector", "traj_ids"] = ends.cumsum(0) - ends.long()
        self.last = ends.nonzero().squeeze(-1)[data["collector", "traj_ids"]]
        data["next", "done"] = ends.unsqueeze(-1)
        data["next", "terminated"] = torch.zeros_like(data["next", "done"])
        data["next", "reward"] = reward(
            data["next", "achieved_goal"], data["desired_goal"]
        )
        transform = GoalSampler.from_env(
            env,
            goal_strategies,
            reward_fn=reward,
            success_fn=None,
            terminated_fn=self.is_success,
            discount=discount,
        )
        self.rows = transform.prepare(data)
        self._buffer = TensorDictReplayBuffer(
            storage=TensorStorage(self.rows, device=env.device), transform=transform
        )

    def __len__(self) -> int:
        return len(self.rows)

    def sample(self, batch_size: int) -> TensorDictBase:
        """Draw transitions and their goals.

        Returns:
            Transitions (batch_size,) with a goal under each key of
            ``goal_strategies``, and with their row numbers in the data under ``index``.
        """
        return self._buffer.sample(batch_size)
