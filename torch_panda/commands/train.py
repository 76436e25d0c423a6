"""Train DDPG, TD3, SAC or TQC with hindsight experience replay on any task.

    python -m torch_panda train --env-id PandaPush-v1 --algo td3 --total-steps 300000

The default preset has the hyperparameters of the panda-gym paper (arXiv 2106.13687) or,
where the paper gives none, those of the HER of OpenAI Baselines. `--preset tuned` uses
the recipe of the task in `torch_panda.learning.recipes`.
"""

from collections.abc import Sequence
from pathlib import Path

import tyro

import torch_panda
from torch_panda.datasets import read_demos
from torch_panda.learning.checkpoint import (
    StopSignal,
    check_folder,
    lock_folder,
    write_options,
)
from torch_panda.learning.options import Args, check, default_args
from torch_panda.learning.recipes import find_recipe
from torch_panda.learning.training import Run
from torch_panda.learning.user_modules import import_modules, read_modules
from torch_panda.learning.video import record


def parse(arguments: Sequence[str] | None = None) -> Args:
    """Read the command line.

    The command line is parsed twice, because preset and task determine the defaults of
    the other options.

    Raises:
        ValueError: A module of ``--import`` does not exist.
    """
    prog = "python -m torch_panda train"
    first_args = tyro.cli(Args, prog=prog, args=arguments)
    import_modules(read_modules(first_args.imports))
    default = default_args(first_args.preset, first_args.env_id)
    return tyro.cli(Args, prog=prog, args=arguments, default=default)


def make_run(args: Args, out: Path) -> Run:
    """Prepare a training, and read its demonstrations if the options name any.

    Raises:
        ValueError: An option does not fit the task or another option, or a file cannot
            be read.
    """
    demos = None
    if args.demos is not None:
        with torch_panda.make(args.env_id) as env:
            demos = read_demos(args.demos, env)
    return Run(args, out, demos)


def main(args: Args) -> None:
    """Train, and print where the results are."""
    out = args.out or Path("runs") / f"{args.env_id}-{args.algo}-{args.her}-{args.seed}"
    try:
        check(args)
        check_folder(out, resume=args.resume)
        run = make_run(args, out)
        if args.preset == "tuned" and not find_recipe(args.env_id):
            print(f"{args.env_id} has no recipe: training as in the panda-gym paper")
        stop = StopSignal()
        with lock_folder(out):
            write_options(out, args, default_args(args.preset, args.env_id))
            finished = run.train(stop)
    except (ValueError, OSError) as error:
        raise SystemExit(str(error)) from None
    stop.release()
    run.close()
    if finished and args.video:
        try:
            with torch_panda.make(
                args.env_id, num_envs=4, seed=args.seed, device=args.device
            ) as env:
                record(env, run.agent.policy, out / "video.mp4")
        except KeyboardInterrupt:
            print("interrupted: no video was written")
    progress = run.progress
    print(f"success {progress.success} after {progress.steps} steps; see {out}")
    if not finished:
        print(f"stopped and saved in {out}: the same command with --resume goes on")


def run(arguments: Sequence[str]) -> None:
    """Read the options and train."""
    try:
        args = parse(arguments)
    except ValueError as error:
        raise SystemExit(str(error)) from None
    main(args)
