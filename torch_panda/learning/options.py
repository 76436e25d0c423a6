"""Options of a training run, and checks of their values."""

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from typing_extensions import Self

from torch_panda.bullet import PhysicsName
from torch_panda.checks import check_device
from torch_panda.learning.agents import find_agent
from torch_panda.learning.agents.hyperparameters import Algo, Hyperparameters
from torch_panda.learning.buffers import Hindsight
from torch_panda.learning.environments import is_from_gymnasium, refusal
from torch_panda.learning.files.logger import LoggerName, check_logger
from torch_panda.learning.limits import (
    Count,
    Factor,
    Finite,
    Positive,
    Ratio,
    Seed,
    Weight,
    check_limits,
)
from torch_panda.learning.recipes import OFFLINE, find_recipe
from torch_panda.learning.user_modules import Imports

DEMO_RATIO = 0.25  # fraction of each batch that comes from the demonstrations

KINDS = ("noisy", "play", "random")  # kinds of `torch_panda.datasets.generate`

Preset = Literal["recipe", "paper", "offline"]


@dataclass
class ResearchOptions(Hyperparameters):
    """Options that research varies. The recipe sets them for every task."""

    her: Hindsight = "relabel"
    """hindsight goals. "relabel" relabels four of five transitions when they are
    sampled. "parts" does the same with a separate draw for each object's part of the
    goal. "geometric", the default of CRL, relabels every transition with the goal
    achieved k steps later, with probability proportional to gamma**k. "none" uses no
    hindsight"""
    desired_ratio: Ratio = 0.0
    """fraction of the hindsight goals that are desired goals of random transitions. The
    rest are goals achieved later in the same episode"""
    keep_unmoved: Ratio = 1.0
    """fraction of the rollouts in which the achieved goal does not change that the
    replay buffer stores. It stores all others. A rollout is the steps of one
    environment in one iteration"""
    num_envs: Positive = 4
    """number of environments stepped in parallel; with --offline, while data are
    generated"""
    updates_per_step: Weight = 0.5
    """gradient steps per environment step"""
    batch_size: Positive = 256
    """transitions per gradient step"""
    randomize: Factor = 1.0
    """largest factor f of domain randomization. For every training episode, the mass
    and friction of the objects and the friction of the table are drawn between 1 / f
    and f times the task's values; 1 changes nothing"""
    pretrain_updates: Count = 0
    """gradient steps that imitate the demonstrations before the first environment step.
    During these, the learning rate falls to 0"""


@dataclass
class RunOptions:
    """Options that one may want to change: the task, the training and its files."""

    preset: Preset = "paper"
    """defaults of the other options: one recipe for all tasks, also for your own
    ("recipe"), those of the panda-gym paper ("paper"), or those of --offline
    ("offline")"""
    env_id: str = "PandaReach-v1"
    """id of the environment, shipped or registered by --import"""
    imports: Imports = ()
    """module or .py file to import first, which registers ids of your own"""
    task_options: dict[str, Finite] = field(default_factory=dict)
    """arguments of the task to change, such as `clearance 0.0005`, also in
    evaluations and generated data"""
    physics: PhysicsName = "exact"
    """how Bullet integrates, also in evaluations and generated data: "exact" as in
    panda-gym, or "fast" and coarser"""
    seed: Seed = 0
    """seed of the environments, the generated data, the networks and the sampling"""
    seeds: tuple[Seed, ...] = ()
    """with --offline, seeds of several runs that take their gradient steps together, to
    make use of a GPU. Each run writes its own folder. Apart from rounding, its policy
    is that of a run with this seed alone"""
    total_steps: Count = 4_000
    """environment steps, summed over all environments; 0 stops after the
    `pretrain_updates`. With --offline, gradient steps"""
    stop_when_solved: bool = False
    """end the training when three evaluations in a row are successful in all episodes.
    A --total-steps on the command line turns this off"""
    eval_interval: Positive = 400
    """steps between evaluations"""
    start_at_reached: Ratio = 0.0
    """fraction of training episodes that start in rare states which the agent itself
    has reached, for tasks whose goals are rarely reached by chance. The recipe sets it
    for goals of several objects. If it is above 0, all training episodes last at most
    50 steps"""
    demos: Path | None = None
    """demonstrations to learn from, in addition to the transitions of the run: a file
    of `record`, or the folder of a data set"""
    data: str = "noisy"
    """with --offline, data to learn from: "noisy", "play" or "random" generates a data
    set, see `torch_panda.datasets.generate`, and keeps it in data.pt of the run's
    folder. Any other value is the path of a file of `record`, of the data.pt of another
    run, or of the folder of a data set"""
    transitions: Positive = 1_000_000
    """with --offline, transitions to generate, rounded up to whole episodes"""
    out: Path | None = None
    """folder of the results; None means runs/<env-id>-<algo>-<her>-<seed>, with
    --offline the data instead of <her>. With --seeds, -<seed> is added to a folder"""
    resume: bool = False
    """continue the run in the folder. Only --out, --video, --import, --logger, --device
    and --workers may differ from the options with which it was started, and
    --total-steps may be larger"""
    device: str = "cpu"
    """device of the networks and the data"""
    workers: Positive = 1
    """processes for environments of Gymnasium: 1 steps them in this process, and a
    larger number gives each of them a process of its own"""
    video: bool = True
    """record a video of 4 episodes at the end"""
    logger: LoggerName = "none"
    """also log each evaluation to TensorBoard (folder "tensorboard" of the run) or to
    Weights & Biases (project "torch_panda"); curve.csv is always written"""


@dataclass
class Args(RunOptions, ResearchOptions):
    """All options of a training."""

    @property
    def env_options(self) -> dict[str, Any]:
        """Arguments of `torch_panda.make` for all environments of the run."""
        return {"task_options": self.task_options, "physics": self.physics}


@dataclass
class ArgGroups:
    """Train an agent in a task of torch_panda, of your own, or of Gymnasium."""

    run: RunOptions
    research: ResearchOptions

    @classmethod
    def from_args(cls, args: Args) -> Self:
        """Divide options into the groups."""
        groups = (
            {field.name: getattr(args, field.name) for field in fields(group)}
            for group in (RunOptions, ResearchOptions)
        )
        run, research = groups
        return cls(RunOptions(**run), ResearchOptions(**research))

    def to_args(self) -> Args:
        """Join the groups."""
        return Args(**vars(self.run), **vars(self.research))


# Options that environments of Gymnasium do not have.
OWN_OPTIONS = ("task_options", "physics", "start_at_reached", "randomize", "demos")


# Options that have an effect only with an environment, or only with --offline.
ONLINE_OPTIONS = (
    *("double_q", "action_l2", "ema_rate", "noise_eps"),
    *("random_eps", "exploration", "fine_fingers", "augmentation", "her", "critics"),
    *("desired_ratio", "keep_unmoved", "updates_per_step", "randomize"),
    *("pretrain_updates", "start_at_reached", "demos", "workers"),
)
OFFLINE_OPTIONS = ("alpha", "actor_goal", "data", "transitions", "seeds")


# CRL needs these goals: the critic's positive goals are achieved k steps later in the
# same episode, with probability proportional to gamma**k.
CRL_OPTIONS: dict[str, Any] = {"her": "geometric", "desired_ratio": 0.0}


def check_exploration(hp: Hyperparameters, num_envs: int) -> None:
    """Check that DDPG, TD3 and CRL explore, by noise or by random actions.

    Raises:
        ValueError: The exploration noise is 0 in all environments.
    """
    explores = hp.noise_eps or any(hp.random_eps[:num_envs])
    if hp.algo in ("ddpg", "td3", "crl") and not explores:
        raise ValueError(
            f"algo {hp.algo} explores by noise_eps and random_eps: one of them must "
            "be above 0"
        )


def check_crl(args: Args) -> None:
    """Check that every goal of a batch is achieved later in the same episode.

    Raises:
        ValueError: An option gives transitions other goals.
    """
    if args.her != "geometric" or args.desired_ratio:
        raise ValueError(
            "algo crl learns only from goals achieved later in the same episode: pass "
            "--her geometric --desired-ratio 0"
        )
    if args.demos is not None:
        raise ValueError(
            "algo crl cannot use demonstrations, whose goals are not drawn as those of "
            "--her geometric: drop --demos, or choose another --algo"
        )


def check_offline(args: Args) -> None:
    """Check the options of an offline training.

    Raises:
        ValueError: The data do not exist, or the algorithm does not have an option.
    """
    if args.data not in KINDS and not Path(args.data).exists():
        raise ValueError(
            f"data must be one of {', '.join(KINDS)}, or a file or folder, got "
            f"{args.data!r}"
        )
    if args.algo == "gcbc" and args.alpha is not None:
        raise ValueError("algo gcbc has no alpha: drop --alpha")
    if len(set(args.seeds)) < len(args.seeds):
        raise ValueError(f"seeds must differ, got {', '.join(map(str, args.seeds))}")
    if args.seeds and args.seed:
        raise ValueError("seed has no effect with --seeds: drop --seed")
    if args.seeds and args.stop_when_solved:
        raise ValueError(
            "seeds learn together until the last step: drop --stop-when-solved, or "
            "train each seed alone with --seed"
        )
    default = Args(**OFFLINE)
    for name in ("transitions", "num_envs"):
        if args.data not in KINDS and getattr(args, name) != getattr(default, name):
            raise ValueError(
                f"{name} has no effect with the data of {args.data}: drop "
                f"--{name.replace('_', '-')}"
            )


def check(args: Args) -> None:
    """Check options before the training starts.

    Raises:
        ValueError: An option is outside its limits, or two options are incompatible.
    """
    check_limits(args)
    find_agent(args)
    default = Args(**OFFLINE) if args.offline else Args()
    without_effect = ONLINE_OPTIONS if args.offline else OFFLINE_OPTIONS
    for name in without_effect:
        if getattr(args, name) != getattr(default, name):
            raise ValueError(
                f"{name} has no effect {'with' if args.offline else 'without'} "
                f"--offline: drop --{name.replace('_', '-')}"
            )
    if args.offline:
        check_offline(args)
    else:
        check_exploration(args, args.num_envs)
        if args.algo == "crl":
            check_crl(args)
        if args.critics == "parts" and args.algo != "ddpg":
            raise ValueError(
                f"critics parts needs algo ddpg, got {args.algo}: pass --critics whole"
            )
    if args.pretrain_updates and args.demos is None:
        raise ValueError("pretrain_updates needs demonstrations: pass --demos")
    has_demos = args.demos is not None and args.total_steps > 0
    if has_demos and DEMO_RATIO * args.batch_size < 1:
        raise ValueError(
            f"batch_size must be at least {1 / DEMO_RATIO:g} with demos, which are "
            f"{DEMO_RATIO:.0%} of each batch, got {args.batch_size}"
        )
    if not args.total_steps and not args.pretrain_updates:
        raise ValueError("total_steps must be positive without pretrain_updates, got 0")
    if not args.offline and is_from_gymnasium(args.env_id):
        refused = [x for x in OWN_OPTIONS if getattr(args, x) != getattr(default, x)]
        if refused:
            raise refusal(args.env_id, *refused)
    check_device(args.device)
    check_logger(args.logger)


def default_args(preset: Preset, env_id: str, algo: Algo | None = None) -> Args:
    """Return the default options of a preset for the task of an id and an algorithm.

    None as the algorithm means the default of the preset.
    """
    options: dict[str, Any] = {}
    if preset == "offline":
        options = dict(OFFLINE)
    elif preset == "recipe":
        options = find_recipe(env_id)
    if algo is not None:
        options["algo"] = algo
        if algo != "ddpg":
            options.pop("critics", None)
    if algo == "crl" and preset != "offline":
        options |= CRL_OPTIONS
    return Args(preset=preset, env_id=env_id, **options)
