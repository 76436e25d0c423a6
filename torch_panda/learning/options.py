"""Options of a training, and the checks that they fit each other."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from torch_panda.learning.agents import Hyperparameters
from torch_panda.learning.buffers import Hindsight
from torch_panda.learning.limits import (
    Count,
    Factor,
    Positive,
    Ratio,
    Seed,
    Weight,
    check_device,
    check_limits,
)
from torch_panda.learning.recipes import find_recipe
from torch_panda.learning.user_modules import Imports


@dataclass
class Args(Hyperparameters):
    """What to train, how long, and where to write."""

    preset: Literal["paper", "tuned"] = "paper"
    """take the defaults of the other options from the paper's table, or from the task's
    recipe; "tuned" stores only a tenth of the episodes in which nothing moved, too"""
    env_id: str = "PandaReach-v1"
    """the task, one of torch_panda.ENV_IDS"""
    her: Hindsight = "relabel"
    """give sampled transitions hindsight goals ("relabel"), each object's part of a
    goal on its own ("parts"), store relabelled copies ("augment"), or do without: four
    for each goal of one's own"""
    desired_ratio: Ratio = 0.0
    """of hindsight goals, the ratio that are the desired goal of another transition
    instead of one that the episode reached later"""
    seed: Seed = 0
    """the seed of the environments, the networks and the sampling"""
    num_envs: Positive = 4
    """the number of environments that are stepped in parallel"""
    total_steps: Count = 4_000
    """environment steps, over all environments; 0 stops after `pretrain_updates`"""
    updates_per_step: Weight = 0.5
    """gradient steps per environment step"""
    batch_size: Positive = 256
    """transitions per gradient step"""
    anneal_lr: bool = False
    """let the learning rate fall to 0, linearly, until the last step"""
    start_at_object: Ratio = 0.0
    """the ratio of training episodes that begin in the course of the task: with the
    hand at an object, or holding it, or, of Stack, with the first cube placed (see
    torch_panda/learning/starts.py); episodes then last at most 50 steps"""
    randomize: Factor = 1.0
    """masses and frictions of objects and table, drawn for every training episode, lie
    between the task's, divided and multiplied by this; 1: they are the task's"""
    demos: Path | None = None
    """a file of demonstrations to learn from beside one's own transitions"""
    pretrain_updates: Count = 0
    """gradient steps that only imitate the demonstrations, before the first step of the
    environments; the learning rate falls to 0 in them"""
    eval_interval: Positive = 400
    """environment steps between evaluations"""
    out: Path | None = None
    """the folder of the results; None means runs/<env-id>-<algo>-<her>-<seed>"""
    imports: Imports = ()
    """module or .py file to import first, which registers ids of your own"""
    resume: bool = False
    """continue the run in that folder, with the same other options"""
    device: str = "cpu"
    """the device of the networks and the replay buffer"""
    video: bool = True
    """record 4 episodes at the end"""


def check_exploration(hp: Hyperparameters, num_envs: int) -> None:
    """Refuse to explore in none of so many environments.

    Raises:
        ValueError: the algorithm explores by options that are all 0 there.
    """
    explores = hp.noise_eps or any(hp.random_eps[:num_envs])
    if hp.algo in ("ddpg", "td3") and not explores:
        raise ValueError(
            f"algo {hp.algo} explores by noise_eps and random_eps: one of them must "
            "be above 0"
        )


def check(args: Args) -> None:
    """Refuse options that would end the training later.

    Raises:
        ValueError: says which, and what is accepted.
    """
    check_limits(args)
    check_exploration(args, args.num_envs)
    if args.pretrain_updates and args.demos is None:
        raise ValueError("pretrain_updates needs demos to imitate")
    if not args.total_steps and not args.pretrain_updates:
        raise ValueError("total_steps must be positive without pretrain_updates, got 0")
    check_device(args.device)


def default_args(preset: str, env_id: str) -> Args:
    """The options of a preset for a task."""
    if preset == "paper":
        return Args(env_id=env_id)
    return Args(preset="tuned", env_id=env_id, **find_recipe(env_id))
