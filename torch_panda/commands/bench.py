"""Benchmark: speed of torch_panda and of other vector environments.

The contenders take turns (A B C, A B C, ...), so that other work on the machine slows
all of them alike. Each turn runs in a new process, which makes the environments, warms
up and measures. Only one contender is in memory at any time.

A step of one contender may last longer than that of another. So the contenders are
compared by the time that they simulate in a second.
"""

import math
import os
import re
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
import tyro
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, GymEnv, ParallelEnv
from tqdm import tqdm

import torch_panda
from torch_panda.bullet.pool import num_cores
from torch_panda.bullet.solver import SOLVER_VARIABLE
from torch_panda.learning import files
from torch_panda.learning.limits import Positive, check_limits
from torch_panda.learning.user_modules import Imports, import_modules


@dataclass(frozen=True)
class Setting:
    """A workload that all contenders run. `Args` explains the attributes."""

    env_id: str
    num_envs: int
    num_threads: int
    render_size: int | None = None
    imports: tuple[str, ...] = ()


class Environments(NamedTuple):
    """Environments of a contender. ``step`` steps all of them with random actions."""

    step: Callable[[], object]
    close: Callable[[], object]


# Contenders -------------------------------------------------------------------


def _wrap_torchrl(env: EnvBase) -> Environments:
    td: TensorDictBase = env.reset()

    def step() -> None:
        nonlocal td
        td["action"] = torch.rand(env.action_spec.shape) * 2 - 1
        _, td = env.step_and_maybe_reset(td)

    return Environments(step, env.close)


def _wrap_vector_env(
    env: Any,  # noqa: ANN401 (of Gymnasium, Stable-Baselines3 or EnvPool)
    num_envs: int,
    action_space: gymnasium.Space[Any],
) -> Environments:
    rng = np.random.default_rng(0)
    shape = (num_envs, gymnasium.spaces.flatdim(action_space))
    env.reset()

    def step() -> None:
        env.step(rng.uniform(-1, 1, size=shape).astype(action_space.dtype))

    return Environments(step, env.close)


def _make_env(setting: Setting, **options: Any) -> torch_panda.RobotTaskEnv:  # noqa: ANN401 (options of make)
    if setting.render_size is not None:
        options |= {"from_pixels": True, "render_size": setting.render_size}
    return torch_panda.make(
        setting.env_id,
        num_envs=setting.num_envs,
        num_threads=setting.num_threads,
        seed=0,
        **options,
    )


def _make_ours(setting: Setting, **options: Any) -> Environments:  # noqa: ANN401 (options of make)
    return _wrap_torchrl(_make_env(setting, **options))


def _make_bare_bullet(setting: Setting) -> Environments:
    """Make environments that only run our loop in C, with Bullet's own solver.

    The first episode computes its setpoints from random actions. Later episodes repeat
    these setpoints, and then only the loop is measured.
    """
    env = _make_env(setting)
    env.reset()
    simulation, control = env.episodes.simulation, env.robot.motor_control
    start = simulation.state.rows.clone()
    setpoints: list[np.ndarray] = []
    num_steps = 0

    def step() -> None:
        nonlocal num_steps
        if num_steps == env.max_episode_steps:
            simulation.state.rows.copy_(start)
            simulation.reset(range(setting.num_envs))
            num_steps = 0
        if num_steps == len(setpoints):
            action = env.action_spec.rand()
            setpoints.append(env.robot.setpoint(action, simulation).numpy())
        simulation.step(control, setpoints[num_steps])
        num_steps += 1

    return Environments(step, env.close)


def _panda_gym_id(setting: Setting) -> str:
    # The prefix names the module whose import registers the id.
    return f"panda_gym:{setting.env_id.rsplit('-', 1)[0]}-v3"


def _make_panda_gym_env(setting: Setting) -> gymnasium.Env[Any, Any]:
    if setting.render_size is None:
        return gymnasium.make(_panda_gym_id(setting))
    env = gymnasium.make(
        _panda_gym_id(setting),
        render_mode="rgb_array",
        renderer="Tiny",
        render_width=setting.render_size,
        render_height=setting.render_size,
    )
    return gymnasium.wrappers.AddRenderObservation(env, render_only=True)


def _make_async(
    make_env: Callable[[Setting], gymnasium.Env[Any, Any]], setting: Setting
) -> Environments:
    env = gymnasium.vector.AsyncVectorEnv(
        [partial(make_env, setting)] * setting.num_envs, context="fork"
    )
    return _wrap_vector_env(env, setting.num_envs, env.single_action_space)


def _make_sb3(setting: Setting) -> Environments:
    from stable_baselines3.common.vec_env import SubprocVecEnv

    env = SubprocVecEnv(
        [partial(_make_panda_gym_env, setting)] * setting.num_envs, start_method="fork"
    )
    return _wrap_vector_env(env, setting.num_envs, env.action_space)


def _make_parallel(setting: Setting) -> Environments:
    make_env = partial(GymEnv, _panda_gym_id(setting))
    return _wrap_torchrl(
        ParallelEnv(setting.num_envs, make_env, mp_start_method="fork")
    )


def _fetch_id(setting: Setting) -> str:
    """Return the id of the Fetch robot's task of the same name."""
    task = setting.env_id.removeprefix("Panda").rsplit("-", 1)[0]
    return f"Fetch{task}-v4"


def _make_fetch_env(setting: Setting) -> gymnasium.Env[Any, Any]:
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    return gymnasium.make(_fetch_id(setting))


def _make_envpool(setting: Setting, env_id: str | None = None) -> Environments:
    import envpool

    env = envpool.make(
        env_id or _fetch_id(setting),
        env_type="gymnasium",
        num_envs=setting.num_envs,
        num_threads=setting.num_threads,
    )
    return _wrap_vector_env(env, setting.num_envs, env.action_space)


class Contender(NamedTuple):
    """Vector environment to compare.

    Attributes:
        title: Name in the table.
        make: Makes the environments of a setting.
        step_length: Time that a step simulates [s].
        solver: Value for the environment variable `SOLVER_VARIABLE`; None does not set
            the variable.
        renders: Whether the environments can observe pictures.
    """

    title: str
    make: Callable[[Setting], Environments]
    step_length: float = 0.04
    solver: str | None = None
    renders: bool = False


OURS = "torch_panda"
CONTENDERS = {
    OURS: Contender("torch_panda", _make_ours, renders=True),
    "fast": Contender(
        'torch_panda, physics="fast"', partial(_make_ours, physics="fast"), renders=True
    ),
    "bullet-solver": Contender(
        "torch_panda, Bullet's own solver", _make_ours, solver="bullet"
    ),
    "bare-bullet": Contender(
        "bare Bullet, C threads", _make_bare_bullet, solver="bullet"
    ),
    "async": Contender(
        "panda-gym, AsyncVectorEnv",
        partial(_make_async, _make_panda_gym_env),
        renders=True,
    ),
    "sb3": Contender("panda-gym, SB3 SubprocVecEnv", _make_sb3),
    "parallel": Contender("panda-gym, torchrl ParallelEnv", _make_parallel),
    "fetch": Contender(
        "Fetch (MuJoCo), AsyncVectorEnv", partial(_make_async, _make_fetch_env)
    ),
    "envpool-fetch": Contender("Fetch (MuJoCo), EnvPool", _make_envpool),
    # MuJoCo Playground's task, which is the same whatever the id of the setting.
    "envpool-panda": Contender(
        "PandaPickCube (MuJoCo), EnvPool",
        partial(_make_envpool, env_id="PandaPickCube-v1"),
        step_length=0.02,
    ),
}


@dataclass
class Args:
    """Compare the speed of vector environments, which take turns."""

    ids: tuple[str, ...] = ("PandaPush-v3",)
    """environments to measure; `python -m torch_panda info` lists the ids"""
    num_envs: tuple[Positive, ...] = (16,)
    """numbers of environments stepped in parallel"""
    num_threads: Positive | None = None
    """number of threads of contenders that use threads; None means one per core
    that the process may use, and at most one per environment"""
    others: tuple[str, ...] = tuple(name for name in CONTENDERS if name != OURS)
    """contenders beside torch_panda. A contender whose libraries are missing is left
    out"""
    rounds: Positive = 7
    """number of turns of each contender; the table shows the median"""
    steps: Positive = 300
    """steps of each environment in a turn, after as many steps that warm up"""
    render_size: Positive | None = None
    """width and height of pictures to observe [pixels]; measures only torch_panda,
    `fast` and `async`"""
    plot: Path | None = None
    """picture of the speeds to write, for instance speed.png"""
    imports: Imports = ()
    """module or .py file to import first, which registers ids of your own"""


# Measurement ------------------------------------------------------------------


class Measurement(NamedTuple):
    """Result of one turn.

    Attributes:
        speed: Time that all environments together simulate in a second [s/s].
        cpu_speed: The simulated time divided by the processor time of all processes
            [s/s]. Other work on the machine hardly changes it. NaN except on Linux.
        creation: Time to create one environment, without imports [s].
        memory: Memory of one environment [MB]. NaN except on Linux.
    """

    speed: float
    cpu_speed: float
    creation: float
    memory: float


Results = dict[tuple[Setting, str], list[Measurement]]


def compare(
    settings: Sequence[Setting], names: Sequence[str], *, rounds: int, steps: int
) -> tuple[Results, list[str]]:
    """Measure contenders in turns: A B C, A B C, and so on.

    A contender that fails takes no further turns. Ctrl-C ends the measurement. In both
    cases the results until then are kept.

    Returns:
        The measurements of each setting and contender in the order of the turns, and
        lines that explain missing measurements.
    """
    results: Results = {}
    failures: list[str] = []
    turns = [(setting, name) for setting in settings for name in names]
    failed = set()
    try:
        for setting, name in tqdm(turns * rounds, unit="turn"):
            if (setting, name) in failed:
                continue
            try:
                measurement = measure(name, setting, steps)
                results.setdefault((setting, name), []).append(measurement)
            except Exception as error:  # a library may raise any error
                failed.add((setting, name))
                title = CONTENDERS[name].title
                failures.append(f"{title} failed: {type(error).__name__}: {error}")
    except KeyboardInterrupt:
        failures.append("interrupted: later turns are missing")
    return results, list(dict.fromkeys(failures))


def measure(name: str, setting: Setting, steps: int) -> Measurement:
    """Measure one turn of a contender in a new process.

    Raises:
        Exception: The contender's own error, or ``BrokenProcessPool`` if its process
            died.
    """
    # With "forkserver", a server process imports this module once, and each turn forks
    # it. The server has no threads, which would not survive a fork.
    context = get_context("forkserver")
    context.set_forkserver_preload([__name__])
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(_measure_here, name, setting, steps).result()


def _measure_here(name: str, setting: Setting, steps: int) -> Measurement:
    torch.set_num_threads(1)
    import_modules(setting.imports)
    # pybullet prints on stdout whenever it loads a robot.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    contender = CONTENDERS[name]
    if contender.solver is not None:
        os.environ[SOLVER_VARIABLE] = contender.solver
    # A first environment imports all modules, which should not count.
    first = contender.make(replace(setting, num_envs=1, num_threads=1))
    used_before, start = _memory(), time.perf_counter()
    envs = contender.make(setting)
    creation, used = time.perf_counter() - start, _memory() - used_before
    first.close()
    for _ in range(steps):
        envs.step()
    start, cpu_start = time.perf_counter(), _cpu_time()
    for _ in range(steps):
        envs.step()
    seconds, cpu_seconds = time.perf_counter() - start, _cpu_time() - cpu_start
    envs.close()
    n = setting.num_envs
    simulated = n * steps * contender.step_length
    return Measurement(
        simulated / seconds, simulated / cpu_seconds, creation / n, used / n
    )


def _process_tree(pid: int) -> list[int]:
    """Return the ids of a process and of its descendants (Linux only)."""
    paths = Path(f"/proc/{pid}/task").glob("*/children")
    children = [int(child) for path in paths for child in path.read_text().split()]
    return [pid, *(x for child in children for x in _process_tree(child))]


def _memory() -> float:
    """Resident memory of this process and its descendants [MB]; NaN except on Linux.

    A page that n processes share counts 1/n in each.
    """
    if sys.platform != "linux":
        return math.nan
    total = 0
    for pid in _process_tree(os.getpid()):
        text = Path(f"/proc/{pid}/smaps_rollup").read_text()
        match = re.search(r"^Pss: +(\d+) kB", text, re.MULTILINE)
        total += int(match[1]) if match else 0
    return 1024 * total / 1e6


def _cpu_time() -> float:
    """Processor time of this process and its descendants [s]; NaN except on Linux."""
    if sys.platform != "linux":
        return math.nan
    _, *children = _process_tree(os.getpid())
    ticks = 0
    for pid in children:
        # The second field, the program's name, may contain spaces and ends with ")".
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        ticks += int(fields[11]) + int(fields[12])  # user and system time
    return time.process_time() + ticks / os.sysconf("SC_CLK_TCK")


# Report -----------------------------------------------------------------------

_COLUMNS = (
    "environment",
    "envs",
    "threads",
    "contender",
    "steps/s",
    "simulated s/s",
    "torch_panda / this",
    "simulated s/CPU s",
    "created in [ms]",
    "memory [MB]",
)


def table(results: Results) -> str:
    """Markdown table with a row for each setting and contender.

    Speeds are medians and ranges over the rounds. The ratio compares torch_panda's
    simulated time per second with that of the row, round by round.
    """
    rows: list[Sequence[str]] = [_COLUMNS]
    for (setting, name), turns in results.items():
        title, _, step_length, *_ = CONTENDERS[name]
        ours = results.get((setting, OURS), [])
        pairs = zip(ours, turns, strict=False)  # one may have failed in a later round
        rows.append(
            (
                setting.env_id,
                str(setting.num_envs),
                str(setting.num_threads),
                title,
                _spread([turn.speed / step_length for turn in turns], digits=0),
                _spread([turn.speed for turn in turns], digits=0),
                _spread([a.speed / b.speed for a, b in pairs], digits=2),
                _spread([turn.cpu_speed for turn in turns], digits=0),
                f"{1e3 * median(turn.creation for turn in turns):.0f}",
                f"{median(turn.memory for turn in turns):.0f}",
            )
        )
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["| " + " | ".join(map(str.ljust, row, widths)) + " |" for row in rows]
    lines.insert(1, "|" + "|".join("-" * (width + 2) for width in widths) + "|")
    return "\n".join(lines)


def _spread(values: Sequence[float], *, digits: int) -> str:
    """Median and range."""
    if not values:
        return "-"
    return (
        f"{median(values):.{digits}f} "
        f"({min(values):.{digits}f} to {max(values):.{digits}f})"
    )


def plot(path: Path, results: Results) -> None:
    """Draw the speeds: a panel for each setting, and a bar for each contender."""
    from matplotlib.figure import Figure

    from torch_panda.learning.plots import save

    settings = list(dict.fromkeys(setting for setting, _ in results))
    height = 0.8 * len(settings) + 0.3 * len(results)
    figure = Figure(figsize=(7, height), layout="constrained")
    grid = figure.subplots(len(settings), squeeze=False, sharex=True)
    for axes, setting in zip(grid[:, 0], settings, strict=True):
        for (other, name), turns in results.items():
            if other != setting:
                continue
            title = CONTENDERS[name].title
            speeds = [turn.speed for turn in turns]
            middle = median(speeds)
            bar = axes.barh(
                title,
                middle,
                xerr=[[middle - min(speeds)], [max(speeds) - middle]],
                color="tab:blue" if title.startswith("torch_panda") else "tab:gray",
            )
            axes.bar_label(bar, fmt="%.0f", label_type="center", color="white")
        axes.invert_yaxis()
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_title(
            f"{setting.env_id}: {setting.num_envs} environments, "
            f"{setting.num_threads} threads",
            fontsize="medium",
            loc="left",
        )
    grid[-1, 0].set_xlabel("simulated seconds per second")
    save(figure, path)


def check(args: Args) -> None:
    """Check the options before the measurement starts.

    Raises:
        ValueError: An option is wrong.
        OSError: The picture cannot be written.
    """
    check_limits(args)
    if unknown := set(args.others) - set(CONTENDERS):
        raise ValueError(
            f"others must be some of {', '.join(CONTENDERS)}, got {min(unknown)!r}"
        )
    for env_id in args.ids:
        torch_panda.max_episode_steps(env_id)  # refuses an unknown id
    if args.plot is not None:
        from matplotlib.backend_bases import FigureCanvasBase

        args.plot = args.plot.with_suffix(args.plot.suffix or ".png")
        formats = FigureCanvasBase.get_supported_filetypes()
        if args.plot.suffix[1:].lower() not in formats:
            raise ValueError(
                f"plot must end in one of {', '.join(formats)}, got {args.plot.name!r}"
            )
        files.prepare(args.plot)


def run(arguments: Sequence[str]) -> None:
    """Run the command.

    Raises:
        SystemExit: An option is wrong, or torch_panda itself was not measured.
    """
    args = tyro.cli(Args, args=arguments, prog="python -m torch_panda bench")
    try:
        import_modules(args.imports)
        check(args)
    except (ValueError, OSError) as error:
        sys.exit(str(error))
    settings = [
        Setting(
            env_id,
            n,
            min(n, args.num_threads or num_cores()),
            args.render_size,
            args.imports,
        )
        for env_id in args.ids
        for n in args.num_envs
    ]
    names = [
        name
        for name, contender in CONTENDERS.items()
        if (name == OURS or name in args.others)
        and (args.render_size is None or contender.renders)
    ]
    results, failures = compare(settings, names, rounds=args.rounds, steps=args.steps)
    if results:
        print(table(results))
    for failure in failures:
        print(failure)
    if results and args.plot is not None:
        plot(args.plot, results)
    if any((setting, OURS) not in results for setting in settings):
        sys.exit(1)
