"""Data whose every goal says where it is from: (environment, episode, step)."""

import math
import random

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

    Args:
        num_envs: Number of environments.
        lengths: Lengths of episodes, from which each episode draws its own.
        seed: Seed of the lengths and the actions.
        first_env: Number of the first environment.
        first_id: Trajectory id of the first environment's first episode.
    """

    def __init__(
        self,
        num_envs: int,
        lengths: list[int],
        seed: int = 0,
        first_env: int = 0,
        first_id: int = 0,
    ) -> None:
        self.rng = random.Random(seed)
        self.lengths = lengths
        self.env = [*range(first_env, first_env + num_envs)]
        self.episode, self.step = [0] * num_envs, [0] * num_envs
        self.length = [self.rng.choice(lengths) for _ in self.env]
        self.trajectory = [*range(first_id, first_id + num_envs)]
        self.next_id = first_id + num_envs

    def _advance(self, i: int) -> list[int]:
        """Steps environment i.

        Returns:
            Its number, the episode, the steps before and after, the trajectory id, and
            whether the episode is done.
        """
        self.step[i] += 1
        place = self.env[i], self.episode[i], self.step[i] - 1, self.step[i]
        done = self.step[i] >= self.length[i]
        row = [*place, self.trajectory[i], int(done)]
        if done:
            self.episode[i] += 1
            self.step[i], self.length[i] = 0, self.rng.choice(self.lengths)
            self.trajectory[i], self.next_id = self.next_id, self.next_id + 1
        return row

    def chunk(self, steps: int) -> TensorDict:
        """The next steps of every environment, [num_envs, steps]."""
        envs = range(len(self.env))
        rows = torch.tensor([[self._advance(i) for i in envs] for _ in range(steps)])
        rows = rows.transpose(0, 1).contiguous()
        shape, done = rows.shape[:2], rows[..., 5:].bool()
        action = [self.rng.random() for _ in range(2 * shape.numel())]
        return TensorDict(
            {
                "achieved_goal": rows[..., :3].float(),
                "desired_goal": torch.full((*shape, 3), STORED_GOAL),
                "action": torch.tensor(action).view(*shape, 2),
                "collector": {"traj_ids": rows[..., 4].clone()},
                "next": {
                    "achieved_goal": rows[..., [0, 1, 3]].float(),
                    "desired_goal": torch.full((*shape, 3), STORED_GOAL),
                    "reward": torch.full((*shape, 1), STORED_REWARD),
                    "done": done,
                    "terminated": torch.zeros_like(done),
                    "truncated": done.clone(),
                },
            },
            shape,
        )


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
        is_own = (achieved[:, None, :2] == goals[:, :2]).all(-1)
        last_step = torch.where(is_own, goals[:, 2], -1).amax(1)
        assert (goal[:, 2] == last_step).all(), "not the last step"


def check_share(mask: Tensor, probability: float) -> None:
    """Asserts that each of n independent rows may have this probability of being True.

    Correct code fails less than once in 1e9 calls. Hoeffding (1963, theorem 1) bounds
    the tails of the binomial distribution: a share as far from p as s is, on the same
    side, has a probability of at most exp(-n * KL(s, p)).
    """
    share, divergence = float(mask.double().mean()), 0.0
    for s, p in ((share, probability), (1 - share, 1 - probability)):
        if s > 0:
            divergence += s * math.log(s / p) if p > 0 else math.inf
    assert mask.numel() * divergence <= math.log(2e9), (
        f"{share:.1%} of {mask.numel()} rows, expected {probability:.1%}"
    )


def check_counts(counts: Tensor, expected: Tensor, groups: int = 1) -> None:
    """Asserts that counts, (n,), fit their expectations: Pearson's chi-squared test.

    The counts may consist of several groups, each with the right sum. Correct code
    fails about once in 1e9 calls (Laurent and Massart 2000, lemma 1).
    """
    chi2, freedom = ((counts - expected) ** 2 / expected).sum(), len(counts) - groups
    x = math.log(1e9)
    assert chi2 <= freedom + 2 * math.sqrt(freedom * x) + 2 * x


def check_batch(
    batch: TensorDict,
    stored: TensorDict,
    strategy: str,
    her_ratio: float | None = 0.8,
) -> None:
    """Asserts that a sampled batch is right.

    Args:
        batch: Sampled transitions.
        stored: All that the storage holds.
        strategy: Name of the strategy.
        her_ratio: Expected share of relabelled rows. With 0.8, a batch without
            relabelled rows fails if it has 14 rows or more. None skips this check,
            where rows are not relabelled independently, as in slices.
    """
    mask = relabelled(batch)
    if her_ratio is not None:
        check_share(mask, her_ratio)
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
