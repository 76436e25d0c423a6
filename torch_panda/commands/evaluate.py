"""Measure how often a trained policy succeeds.

python -m torch_panda evaluate runs/PandaPush-v1-ddpg-relabel-0 --episodes 200
python -m torch_panda evaluate PandaPush-v1 --tasks fixed
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import sqrt
from typing import Annotated

import tyro
from torch import Tensor

from torch_panda.bullet import PhysicsName
from torch_panda.learning.environments import is_from_gymnasium
from torch_panda.learning.evaluation import Tasks, evaluate, wilson_interval
from torch_panda.learning.files.policy_files import load_policy
from torch_panda.learning.limits import Finite, Positive, Seed, check_limits
from torch_panda.learning.user_modules import Imports, import_modules


@dataclass
class Args:
    """Measure how often a trained policy succeeds."""

    run: Annotated[str, tyro.conf.Positional]
    """folder of a run, its checkpoint.pt, or an id whose policy torch_panda ships"""
    env_id: str | None = None
    """another task with the same spaces; None means the task of the policy"""
    episodes: Positive = 200
    """number of episodes"""
    tasks: Tasks = "random"
    """starts and goals of the episodes: drawn at random ("random"), or those of the
    five evaluation tasks ("fixed"), whose success is printed one by one"""
    num_envs: Positive = 32
    """number of environments stepped in parallel"""
    num_threads: Positive | None = None
    """number of threads that step the environments; None means one per core that the
    process may use"""
    workers: Positive = 1
    """processes for environments of Gymnasium: 1 steps them in this process, and a
    larger number gives each of them a process of its own"""
    seed: Seed = 1_000
    """seed of the environments"""
    task_options: dict[str, Finite] = field(default_factory=dict)
    """arguments of the task to change, such as `clearance 0.0005`"""
    physics: PhysicsName = "exact"
    """how Bullet integrates: "exact" as in panda-gym, or "fast" and coarser"""
    imports: Imports = ()
    """module or .py file to import first, which registers ids of your own"""


def main(args: Args) -> None:
    """Print success rates and return, with 95 % intervals."""
    try:
        check_limits(args)
        import_modules(args.imports)
        policy = load_policy(args.run)
        env_id = args.env_id or policy.env_id
        result = evaluate(
            policy,
            env_id,
            episodes=args.episodes,
            seed=args.seed,
            num_envs=args.num_envs,
            tasks=args.tasks,
            num_threads=args.num_threads,
            workers=args.workers,
            physics=args.physics,
            task_options=args.task_options,
        )
    except (ValueError, TypeError) as error:
        raise SystemExit(str(error)) from None
    changes = "".join(f", {key} {value}" for key, value in args.task_options.items())
    episodes = len(result.success)
    physics = "" if is_from_gymnasium(env_id) else f", {args.physics} physics"
    print(f"{env_id}{changes}, {episodes} episodes{physics}")
    for name, task in result.tasks.items():
        print_share(f"success of {name}", task.success)
    print_share("success at the end", result.success)
    print_share("success at any time", result.ever)
    print_share("solved at the start", result.at_start)
    mean = result.mean_return
    interval = ""
    if episodes > 1:
        half = 1.96 * float(result.returns.std()) / sqrt(episodes)
        interval = f"  [{mean - half:.2f}, {mean + half:.2f}]"
    print(f"{'return':20s} {mean:6.2f}{interval}")
    print(f"{'steps':20s} {result.mean_length:6.1f}")


def print_share(name: str, flags: Tensor) -> None:
    """Print the share of episodes (n,) that have a flag, with its 95 % interval."""
    low, high = wilson_interval(int(flags.sum()), len(flags))
    share = flags.float().mean()
    print(f"{name:20s} {share:6.1%}  [{low:.1%}, {high:.1%}]")


def run(arguments: Sequence[str]) -> None:
    """Read the options and run the command."""
    main(tyro.cli(Args, prog="python -m torch_panda evaluate", args=arguments))
