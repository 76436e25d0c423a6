"""Data whose every goal says where it is from: (environment, episode, step)."""

import torch
from tensordict import TensorDict
from torch import Tensor

STORED_GOAL = -1.0  # in the desired goal, until it is relabelled
STORED_REWARD = -7.0


def reward_fn(achieved: Tensor, desired: Tensor) -> Tensor:
    """0 where the goal is the achieved one, else -1, (..., 1)."""
    return -(achieved != desired).any(-1, keepdim=True).float()


def terminated_fn(achieved: Tensor, desired: Tensor) -> Tensor:
    return (achieved == desired).all(-1, keepdim=True)


class Envs:
    """Environments whose step s of episode e in environment i achieves (i, e, s).

    Steps count from 1, as what is achieved at step 0 is under the root only.
    """

    def __init__(
        self, num_envs: int, lengths: list[int], seed: int = 0, first_env: int = 0
    ) -> None:
        self.rng = torch.Generator().manual_seed(seed)
        self.num_envs = num_envs
        self.lengths = torch.tensor(lengths)
        self.env = torch.arange(num_envs) + first_env
        self.episode = torch.zeros(num_envs, dtype=torch.int64)
        self.step = torch.zeros(num_envs, dtype=torch.int64)
        self.length = self._draw()
        self.trajectory = torch.arange(num_envs)

    def _draw(self) -> Tensor:
        which = torch.randint(len(self.lengths), (self.num_envs,), generator=self.rng)
        return self.lengths[which]

    def _one(self) -> TensorDict:
        place = (self.env, self.episode, self.step)
        root = torch.stack(place, -1).float()
        trajectory = self.trajectory.clone()
        self.step = self.step + 1
        done = self.step >= self.length
        achieved = torch.stack((self.env, self.episode, self.step), -1).float()
        new = self.trajectory.max() + done.cumsum(0)
        self.trajectory = torch.where(done, new, self.trajectory)
        self.episode = self.episode + done
        self.step = torch.where(done, 0, self.step)
        self.length = torch.where(done, self._draw(), self.length)
        n = self.num_envs
        flags = {
            "done": done[:, None],
            "terminated": torch.zeros(n, 1, dtype=torch.bool),
            "truncated": done[:, None].clone(),
        }
        return TensorDict(
            {
                "achieved_goal": root,
                "desired_goal": torch.full((n, 3), STORED_GOAL),
                "action": torch.rand(n, 2, generator=self.rng),
                "collector": {"traj_ids": trajectory},
                "next": {
                    "achieved_goal": achieved,
                    "desired_goal": torch.full((n, 3), STORED_GOAL),
                    "reward": torch.full((n, 1), STORED_REWARD),
                    **flags,
                },
            },
            [n],
        )

    def chunk(self, steps: int) -> TensorDict:
        """The next steps of every environment, [num_envs, steps]."""
        return torch.stack([self._one() for _ in range(steps)], 1)


def name_goals(data: TensorDict) -> TensorDict:
    """Asks each row for (-1 - environment, -1 - episode, -9), with its reward."""
    goal = -1 - data["achieved_goal"]
    goal[..., 2] = -9
    data["desired_goal"], data["next", "desired_goal"] = goal, goal.clone()
    data["next", "reward"] = reward_fn(data["next", "achieved_goal"], goal)
    return data


def relabelled(batch: TensorDict) -> Tensor:
    """Which rows have got another goal, shape of the batch."""
    return (batch["desired_goal"] != STORED_GOAL).any(-1)


def check_goals(
    goal: Tensor, achieved: Tensor, stored: TensorDict, strategy: str
) -> None:
    """Asserts that goals, (n, 3), are where their strategy may draw them.

    Args:
        goal: The drawn goals.
        achieved: What their rows achieved, (n, 3).
        stored: All that the storage holds.
        strategy: Name of the strategy.
    """
    goals = stored["next", "achieved_goal"].flatten(0, -2)
    if strategy == "desired":
        goals = stored["desired_goal"].flatten(0, -2)
    assert (goal[:, None] == goals).all(-1).any(-1).all(), "overwritten or invented"
    if strategy not in ("random", "desired"):
        assert (goal[:, :2] == achieved[:, :2]).all(), "from another trajectory"
    if strategy in ("current", "future", "geometric", "final"):
        assert (goal[:, 2] >= achieved[:, 2]).all(), "from the past"
    if strategy == "current":
        assert (goal == achieved).all(), "from another step"
    if strategy == "final":
        for a, g in zip(achieved, goal, strict=True):
            same = goals[(goals[:, :2] == a[:2]).all(-1)]
            assert g[2] == same[:, 2].max(), "not the last step"


def check_batch(batch: TensorDict, stored: TensorDict, strategy: str) -> None:
    """Asserts that a sampled batch is right, given all that the storage holds."""
    mask = relabelled(batch)
    achieved, goal = batch["next", "achieved_goal"], batch["desired_goal"]
    assert (batch["next", "desired_goal"] == goal).all()
    reward = torch.where(mask[..., None], reward_fn(achieved, goal), STORED_REWARD)
    assert (batch["next", "reward"] == reward).all()
    check_goals(goal[mask], achieved[mask], stored, strategy)


def check_untouched(batch: TensorDict, stored: TensorDict) -> None:
    """Asserts that what was not relabelled is bit for bit what is stored."""
    index = batch["index"]
    index = index.unbind(-1) if index.ndim > 1 else index
    original = stored[index]
    mask = relabelled(batch)
    for key in original.keys(True, True):
        if key in ("index", "hindsight_serial"):
            continue
        value = batch[key]
        assert (value[~mask] == original[key][~mask]).all(), key
        goal_keys = ("desired_goal", ("next", "desired_goal"), ("next", "reward"))
        if key not in goal_keys:
            assert (value == original[key]).all(), key
