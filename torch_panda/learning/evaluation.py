"""Evaluates a policy over many episodes, played in parallel."""

from math import sqrt
from typing import NamedTuple

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

import torch_panda


class Evaluation(NamedTuple):
    """What n episodes came to, each (n,).

    Attributes:
        success: whether the episode's last state is a success.
        ever: whether any state after the first step was.
        at_start: whether the start already was.
        episode_return: sum of the rewards.
    """

    success: torch.Tensor
    ever: torch.Tensor
    at_start: torch.Tensor
    episode_return: torch.Tensor


def evaluate(
    env: torch_panda.RobotTaskEnv, policy: TensorDictModuleBase, episodes: int
) -> Evaluation:
    """Run fresh episodes of a batched environment without exploration noise."""
    parts: list[Evaluation] = []
    steps = env.max_episode_steps
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        while sum(len(part.success) for part in parts) < episodes:
            rollout = env.rollout(steps, policy, break_when_any_done=False)
            following = rollout["next"]
            success, done = following["success"], following["done"]
            # A -v3 episode ends at its first success; what follows is another one.
            first_done = done.cumsum(1).cumsum(1) == 1
            lived = done.cumsum(1) - done.long() == 0
            parts.append(
                Evaluation(
                    (success & first_done).any(1).squeeze(-1),
                    (success & lived).any(1).squeeze(-1),
                    rollout["success"][:, 0].squeeze(-1),
                    (following["reward"] * lived).sum(1).squeeze(-1),
                )
            )
    return Evaluation(
        *(torch.cat(x)[:episodes].cpu() for x in zip(*parts, strict=True))
    )


def wilson_interval(successes: int, n: int, z: float = 1.96) -> tuple[float, float]:
    """95 % interval of a proportion (Wilson, 1927)."""
    p = successes / n
    center = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z * sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    return max(0.0, center - half), min(1.0, center + half)
