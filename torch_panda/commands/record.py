"""Record demonstrations of the scripted experts, and say how often they succeed.

python -m torch_panda record --env-id PandaPush-v1 --episodes 200 --out demos.pt
python -m torch_panda record --format minari --out panda/push-expert-v0
python -m torch_panda record --format lerobot --out push_lerobot
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import tyro
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from tqdm import tqdm

import torch_panda
from torch_panda.datasets.formats import Writer, load_format
from torch_panda.datasets.recording import TensorWriter, disturb, play
from torch_panda.experts import make_expert
from torch_panda.learning.evaluation import wilson_interval
from torch_panda.learning.limits import Finite, Positive, Seed, Weight, check_limits
from torch_panda.learning.user_modules import Imports, import_modules, read_modules


@dataclass
class Args:
    """Record demonstrations of a scripted expert."""

    env_id: str = "PandaPush-v1"
    """task of the expert, with end-effector control"""
    episodes: Positive = 200
    """number of episodes"""
    seed: Seed = 0
    """seed of the environments"""
    num_envs: Positive = 32
    """number of environments that are stepped in parallel"""
    num_threads: Positive | None = None
    """number of threads that step the environments; None means one per core"""
    noise_eps: Weight = 0.0
    """standard deviation of Gaussian noise on the executed actions; the file holds the
    actions without noise, so that imitating them teaches how to correct errors (DART,
    arXiv 1703.09327)"""
    task_options: dict[str, Finite] = field(default_factory=dict)
    """arguments of the task to change, such as `clearance 0.0005`"""
    format: Literal["tensors", "minari", "lerobot"] = "tensors"
    """a file with a nested dict of tensors (transitions, ...), or a data set"""
    out: Path | None = None
    """file to write; for minari the id of the data set, for lerobot its folder; None
    measures success only"""
    image_size: Positive = 128
    """height and width of the pictures of a LeRobot data set [pixels]"""
    imports: Imports = ()
    """module or .py file to import first, which registers ids of your own"""


def print_success(env_id: str, success: list[Tensor]) -> None:
    """Print how many episodes succeeded, with 95 % intervals.

    Args:
        env_id: the task.
        success: of each episode, after each step, (steps, 1).
    """
    for when, count in (
        ("at the end", sum(bool(flags[-1]) for flags in success)),
        ("at any time", sum(bool(flags.any()) for flags in success)),
    ):
        low, high = wilson_interval(count, len(success))
        print(
            f"{env_id}: success {when} {count}/{len(success)} = "
            f"{count / len(success):.1%} (95 % interval {low:.1%} to {high:.1%})"
        )


def open_writer(args: Args, env: torch_panda.RobotTaskEnv) -> Writer | None:
    """Open the writer of the episodes; None if they are only counted.

    Raises:
        ValueError: The library of the format is not installed, or refuses the name.
        OSError: The data cannot be written.
    """
    if args.out is None:
        return None
    if args.format == "tensors":
        return TensorWriter(args.out)
    return load_format(args.format).open_writer(args.out, args.env_id, env)


def main(args: Args) -> None:
    """Play the episodes, print the success rates and save the transitions."""
    try:
        check_limits(args)
        import_modules(read_modules(args.imports))
        expert: TensorDictModuleBase = make_expert(args.env_id)
        if args.noise_eps and args.format == "minari":
            raise ValueError(
                "noise_eps does not work with the format minari, whose episodes hold "
                "the executed actions"
            )
        if args.task_options and args.format != "tensors":
            raise ValueError(
                f"task_options do not work with the format {args.format}, whose data "
                "sets are recreated from an id; use the format tensors"
            )
        pictures: dict[str, Any] = {}
        if args.format == "lerobot":
            pictures = {"from_pixels": True, "render_size": args.image_size}
        env = torch_panda.make(
            args.env_id,
            num_envs=min(args.num_envs, args.episodes),
            num_threads=args.num_threads,
            seed=args.seed,
            task_options=args.task_options,
            **pictures,
        )
        writer = open_writer(args, env)
    except (ValueError, TypeError, OSError) as error:
        raise SystemExit(str(error)) from None
    expert = disturb(expert, env, args.noise_eps)
    success: list[Tensor] = []
    steps = 0
    try:
        with env, tqdm(total=args.episodes, unit="episode", desc=args.env_id) as bar:
            while len(success) < args.episodes:
                first = len(success)
                if args.format != "tensors":  # every episode stores its seed
                    for index in range(env.batch_size[0]):
                        env.set_env_seed(index, args.seed + first + index)
                new = play(env, expert)[: args.episodes - first]
                for index, episode in enumerate(new, first):
                    success.append(episode["next", "success"])
                    if writer is not None:
                        episode["action"] = episode.pop("intended")
                        writer.add(episode, args.seed + index)
                        steps += len(episode)
                bar.update(len(new))
        print_success(args.env_id, success)
        if writer is not None:
            print(f"{steps} transitions in {writer.close()}")
    except KeyboardInterrupt:
        raise SystemExit("stopped") from None


def run(arguments: Sequence[str]) -> None:
    """Read the options and run the command."""
    main(tyro.cli(Args, prog="python -m torch_panda record", args=arguments))
