"""Train DDPG, TD3, SAC or CRL with hindsight experience replay on any task.

    python -m torch_panda train --env-id PandaPush-v1 --algo td3 --total-steps 300000
    python -m torch_panda train --offline --env-id PandaPush-v1 --algo hiql --data noisy

One recipe has the hyperparameters for every task, see `torch_panda.learning.recipes`.
`--preset paper` takes those of the panda-gym paper (arXiv 2106.13687). Where the paper
gives none, it takes those of the HER of OpenAI Baselines.

With ``--offline`` the agent learns from a data set.

`torch_panda.testing.check_task` checks the task before the training begins.
"""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import tyro
from tensordict import TensorDictBase
from tqdm import tqdm

import torch_panda
from torch_panda.datasets import generate, read_demos, sha256
from torch_panda.learning import files
from torch_panda.learning.buffers import STORED_KEYS
from torch_panda.learning.environments import is_from_gymnasium, make_env
from torch_panda.learning.environments.geometry import declares_layout
from torch_panda.learning.environments.spaces import Spaces
from torch_panda.learning.evaluation.video import record
from torch_panda.learning.files.run_files import (
    check_folder,
    lock_folder,
    write_options,
)
from torch_panda.learning.options import (
    KINDS,
    ArgGroups,
    Args,
    check,
    default_args,
)
from torch_panda.learning.training import Run, StopSignal, Training
from torch_panda.learning.user_modules import import_modules
from torch_panda.registry import find_registration
from torch_panda.testing import check_task

PROG = "python -m torch_panda train"
DATA_FILE = "data.pt"  # file of a run's folder with the data that it generated


def parse(arguments: Sequence[str]) -> Args:
    """Read the command line.

    Preset, task and algorithm determine the defaults, so these options are read first.

    Raises:
        ValueError: A module of ``--import`` does not exist, or the preset does not fit
            ``--offline``.
    """
    # The help is printed at the end, with the defaults of this preset and algorithm.
    without_help = [x for x in arguments if x not in ("-h", "--help")]
    recipe = Args(preset="recipe")
    first = tyro.cli(Args, prog=PROG, args=without_help, default=recipe)
    import_modules(first.imports)
    names = [x.split("=")[0].replace("_", "-") for x in arguments]
    if first.offline:
        if "--preset" in names and first.preset != "offline":
            raise ValueError(
                f"--offline goes with the preset offline only, got {first.preset}: "
                "drop --preset"
            )
        first.preset = "offline"
    algo = first.algo if "--algo" in names else None
    default = default_args(first.preset, first.env_id, algo)
    if "--total-steps" in names:
        default.stop_when_solved = False
    groups = tyro.cli(
        ArgGroups,
        prog=PROG,
        args=arguments,
        default=ArgGroups.from_args(default),
        config=(tyro.conf.OmitArgPrefixes,),
    )
    return groups.to_args()


def make_run(args: Args, out: Path) -> Run:
    """Prepare a training, and read its demonstrations or data if the options name any.

    Raises:
        ValueError: An option does not fit the task or another option, or a file cannot
            be read.
        TypeError: The task does not have one of the ``task_options``.
        OSError: Generated data cannot be written.
    """
    if args.offline:
        data = read_data(args, out)
        return Run(args, out, data, sha256(data))
    if args.demos is None:
        return Run(args, out)
    with torch_panda.make(args.env_id, **args.env_options) as env:
        demos = read_demos(args.demos, env).select(*STORED_KEYS)
    return Run(args, out, demos, sha256(demos))


def read_data(args: Args, out: Path) -> TensorDictBase:
    """Read the transitions (n,) to learn from, or generate them into the run's folder.

    Raises:
        ValueError: The data do not exist or do not fit the task, or generated data
            would overwrite a file.
        OSError: Generated data cannot be written.
    """
    path = Path(args.data)
    if args.data in KINDS:
        path = out / DATA_FILE
        if not args.resume:
            if path.exists():
                raise ValueError(
                    f"generated data would overwrite {path}: learn from this file with "
                    f"--data {path}, remove it, or choose another folder with --out"
                )
            with lock_folder(out):
                files.save(path, generate_data(args).to_dict())
    with torch_panda.make(args.env_id, **args.env_options) as env:
        return read_demos(path, env).select(*STORED_KEYS)


def generate_data(args: Args) -> TensorDictBase:
    """Generate a data set, with a progress bar: transitions (n,)."""
    with tqdm(total=args.transitions, unit="transition", unit_scale=True) as bar:
        bar.set_description(f"{args.env_id} {args.data}")
        data = generate(
            args.env_id,
            kind=args.data,  # type: ignore[arg-type]  # one of KINDS
            transitions=args.transitions,
            seed=args.seed,
            num_envs=args.num_envs,
            progress=bar.update,
            **args.env_options,
        )
    return data.select(*STORED_KEYS).reshape(-1)


def default_folder(args: Args) -> Path:
    """Folder of the results if the options name none."""
    variant = Path(args.data).stem if args.offline else args.her
    return Path("runs") / f"{args.env_id}-{args.algo}-{variant}-{args.seed}"


def main(args: Args) -> None:
    """Train, and print where the results are."""
    try:
        check(args)
        folders = find_folders(args)
        for out in folders:
            check_folder(out, resume=args.resume)
        is_declared = False
        if args.offline or not is_from_gymnasium(args.env_id):
            registration = find_registration(args.env_id)
            task = registration.make_task(args.task_options)
            robot = registration.make_robot()
            check_task(task, robot=robot)
            is_declared = declares_layout(robot, task)
        runs = [make_run(options, out) for out, options in folders.items()]
        if args.preset == "recipe":
            spaces = runs[0].agent.spaces
            print(describe_recipe(args, spaces, is_declared=is_declared))
        training = Training(runs)
        stop = StopSignal()
        default = default_args(args.preset, args.env_id, args.algo)
        with ExitStack() as locks:
            for out, options in folders.items():
                locks.enter_context(lock_folder(out))
                write_options(out, options, default, resume=args.resume)
            finished = training.train(stop)
    except (ValueError, TypeError, OSError) as error:
        raise SystemExit(str(error)) from None
    stop.release()
    training.close()
    for out, run in zip(folders, runs, strict=True):
        if finished and args.video:
            record_video(run, out)
        progress = run.progress
        print(f"success {progress.success} after {progress.steps} steps; see {out}")
        if not finished:
            print(f"stopped and saved in {out}: the same command with --resume goes on")


def find_folders(args: Args) -> dict[Path, Args]:
    """Return the folder of each run with its options: one run, or one for each seed."""
    if not args.seeds:
        return {args.out or default_folder(args): args}
    runs = [replace(args, seed=seed, seeds=()) for seed in args.seeds]
    if args.out is None:
        return {default_folder(run): run for run in runs}
    return {args.out.with_name(f"{args.out.name}-{run.seed}"): run for run in runs}


def record_video(run: Run, out: Path) -> None:
    """Record a video of a run's policy into its folder."""
    args = run.args
    try:
        with make_env(
            args.env_id,
            num_envs=4,
            seed=args.seed,
            device=args.device,
            renders=True,
            **args.env_options,
        ) as env:
            record(env, run.agent.policy, out / "video.mp4")
    except KeyboardInterrupt:
        print("interrupted: no video was written")
    except OSError as error:
        print(f"no video was written: {error}")


def describe_recipe(args: Args, spaces: Spaces, *, is_declared: bool) -> str:
    """Describe the options that the recipe derived from a task, on one line."""
    geometry = spaces.geometry
    num_objects = num_goals = 0
    if geometry is not None:
        num_objects = max(len(geometry.positions) - 1, 0)
        num_goals = len(geometry.goal_positions)
    parts = [
        f"discount {args.gamma} for {spaces.max_episode_steps} steps",
        f"{num_objects} objects and {num_goals} goal positions "
        f"({'declared' if is_declared else 'found'})",
        f"hindsight {args.her!r} with {args.desired_ratio:.0%} desired goals",
        f"critics {args.critics!r}",
        f"inputs {args.relative_inputs!r}",
        f"augmentation {args.augmentation!r}",
        f"{args.start_at_reached:.0%} reached starts",
    ]
    return f"{args.env_id}: {', '.join(parts)}"


def run(arguments: Sequence[str]) -> None:
    """Read the options and train."""
    try:
        args = parse(arguments)
    except ValueError as error:
        raise SystemExit(str(error)) from None
    main(args)
