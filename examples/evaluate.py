"""Evaluate a trained policy over many episodes, run in parallel.

python examples/evaluate.py runs/PandaPush-v1-ddpg-relabel-0 --episodes 200
"""

from dataclasses import dataclass, field
from math import sqrt
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
import tyro
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

import torch_panda
from limits import Finite, Positive, Seed, check_limits
from torch_panda import PhysicsName
from training.policies import load_policy, read_checkpoint


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


@dataclass
class Args:
    """Which policy to evaluate, and how long."""

    run: Annotated[Path, tyro.conf.Positional]
    """folder of a run, or its checkpoint.pt"""
    env_id: str | None = None
    """another task with the same spaces; None means the one it was trained on"""
    episodes: Positive = 200
    """number of episodes"""
    num_envs: Positive = 32
    """environments that are stepped in parallel"""
    num_threads: Positive | None = None
    """threads that step them; None means one per core"""
    seed: Seed = 1_000
    """of the environments"""
    task_options: dict[str, Finite] = field(default_factory=dict)
    """numbers of the task that are others than in training, such as `play 0.0005`"""
    physics: PhysicsName = "exact"
    """how Bullet integrates: as panda-gym, or faster and coarser"""


def main(args: Args) -> None:
    """Print what the policy achieves, with 95 % intervals."""
    try:
        check_limits(args)
        checkpoint = read_checkpoint(args.run)
        env_id = args.env_id or checkpoint["env_id"]
        with torch_panda.make(
            env_id,
            num_envs=min(args.num_envs, args.episodes),
            num_threads=args.num_threads,
            seed=args.seed,
            physics=args.physics,
            task_options=args.task_options,
        ) as env:
            policy = load_policy(checkpoint, env)
            result = evaluate(env, policy, args.episodes)
    except (ValueError, TypeError) as error:
        raise SystemExit(str(error)) from None
    changes = "".join(f", {key} {value}" for key, value in args.task_options.items())
    print(f"{env_id}{changes}, {args.episodes} episodes, {args.physics} physics")
    for name, flags in (
        ("success at the end", result.success),
        ("success at any time", result.ever),
        ("solved at the start", result.at_start),
    ):
        low, high = wilson_interval(int(flags.sum()), args.episodes)
        share = flags.float().mean()
        print(f"{name:20s} {share:6.1%}  [{low:.1%}, {high:.1%}]")
    mean = result.episode_return.mean()
    interval = ""
    if args.episodes > 1:
        half = 1.96 * result.episode_return.std() / sqrt(args.episodes)
        interval = f"  [{mean - half:.2f}, {mean + half:.2f}]"
    print(f"{'return':20s} {mean:6.2f}{interval}")


if __name__ == "__main__":
    main(tyro.cli(Args))
