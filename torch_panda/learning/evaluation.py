"""Evaluates a policy over many episodes, which run in parallel."""

from dataclasses import dataclass, fields
from math import sqrt
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torch_panda.checks import check_positive
from torch_panda.envs import RobotTaskEnv
from torch_panda.learning.rollouts import play_episodes
from torch_panda.registry import make


@dataclass(frozen=True)
class Evaluation:
    """Results of n episodes.

    Attributes:
        success: Whether the last state of each episode is a success, (n,) bool.
        ever: Whether any state after the first step is a success, (n,) bool.
        at_start: Whether the start of each episode is a success, (n,) bool.
        returns: Sum of the rewards of each episode, (n,).
        lengths: Number of steps of each episode, (n,).
    """

    success: Tensor
    ever: Tensor
    at_start: Tensor
    returns: Tensor
    lengths: Tensor

    @property
    def success_rate(self) -> float:
        """Share of the episodes that end with success."""
        return float(self.success.double().mean())

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % interval of the success rate."""
        return wilson_interval(int(self.success.sum()), len(self.success))

    @property
    def mean_return(self) -> float:
        """Mean of the returns."""
        return float(self.returns.double().mean())

    @property
    def mean_length(self) -> float:
        """Mean number of steps; episodes of ``-v3`` end with their first success."""
        return float(self.lengths.double().mean())

    def __repr__(self) -> str:
        low, high = self.interval
        return (
            f"Evaluation({len(self.success)} episodes, success_rate="
            f"{self.success_rate:.3f} [{low:.3f}, {high:.3f}], mean_return="
            f"{self.mean_return:.2f}, mean_length={self.mean_length:.1f})"
        )


def evaluate(
    policy: TensorDictModuleBase,
    env_id: str,
    *,
    episodes: int = 200,
    seed: int | None = 1_000,
    num_envs: int = 32,
    **options: Any,  # noqa: ANN401 (those of `make`)
) -> Evaluation:
    """Evaluate a policy on an environment, without exploration noise.

    Args:
        policy: Trained policy, scripted expert, or any module that writes ``action``
            into a batch of observations.
        env_id: Id of the environment.
        episodes: Number of episodes.
        seed: Seed of the episodes; None draws one.
        num_envs: Number of environments stepped in parallel, at most one per episode.
        **options: Other arguments of `make`, such as ``task_options`` and ``device``.

    Raises:
        ValueError: The id is unknown, or an argument is out of range.
        TypeError: The policy is not a module, or an argument is unknown.
    """
    check_positive(episodes=episodes, num_envs=num_envs)
    if not callable(policy):
        raise TypeError(
            f"policy must be a TensorDictModule, got {policy!r}: load_policy reads one "
            "from a file"
        )
    num_envs = min(num_envs, episodes)
    with make(env_id, num_envs=num_envs, seed=seed, **options) as env:
        return evaluate_in(env, policy, episodes)


def evaluate_in(
    env: RobotTaskEnv, policy: TensorDictModuleBase, episodes: int
) -> Evaluation:
    """Evaluate a policy over the next episodes of a batch of environments."""
    parts: list[Evaluation] = []
    while sum(len(part.success) for part in parts) < episodes:
        rollout, lengths = play_episodes(env, policy)
        success = rollout["next", "success"].squeeze(-1)
        reward = rollout["next", "reward"].squeeze(-1)
        steps = torch.arange(rollout.shape[1], device=lengths.device)
        is_played = steps < lengths[:, None]
        parts.append(
            Evaluation(
                success=success.gather(1, lengths[:, None] - 1).squeeze(1),
                ever=(success & is_played).any(1),
                at_start=rollout["success"][:, 0, 0],
                returns=(reward * is_played).sum(1),
                lengths=lengths,
            )
        )
    joined = {
        field.name: torch.cat([getattr(part, field.name) for part in parts])
        for field in fields(Evaluation)
    }
    return Evaluation(**{name: x[:episodes].cpu() for name, x in joined.items()})


def wilson_interval(successes: int, n: int, z: float = 1.96) -> tuple[float, float]:
    """95 % interval of a proportion (Wilson, 1927)."""
    p = successes / n
    center = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z * sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    return max(0.0, center - half), min(1.0, center + half)
