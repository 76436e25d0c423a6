"""The options of ``train.py --preset tuned``: what this library learned a task with.

What a recipe leaves out is as in the panda-gym paper, the default. Options given on the
command line come before a recipe's.
"""

from dataclasses import asdict
from typing import Any

from torch_panda.registry import find_registration
from torch_panda.tasks import (
    Drawer,
    Flip,
    PegInsertion,
    PickAndPlace,
    Push,
    Reach,
    Slide,
    Stack,
    Task,
)

# Every object task: hindsight about what moved, and symmetry.
OBJECT: dict[str, Any] = {
    "num_envs": 8,
    "gamma": 0.95,
    "random_eps": (0.3, 1.0),
    "relative_inputs": "coarse",
    "augmentation": "mirror-shift",
    "eval_interval": 5_000,
}
# What is no other way to train: other runs of the same line in a plot.
PLAIN_OPTIONS = {
    *("algo", "seed", "total_steps", "eval_interval"),
    *("out", "resume", "device", "video", "imports"),
}
# What joint control cannot do.
END_EFFECTOR_OPTIONS = ("augmentation", "start_at_object")
RECIPES: dict[type[Task], dict[str, Any]] = {
    Reach: {"num_envs": 8, "gamma": 0.95, "relative_inputs": "coarse"},
    # One environment takes no random actions, and the last one half: learned twice as
    # soon as with 30 to 100 %.
    Push: {**OBJECT, "random_eps": (0.0, 0.5), "total_steps": 100_000},
    # Goals out of reach are seldom achieved: some of the batch get them all the same.
    # One environment takes no random actions: where the puck stops depends on the whole
    # strike, and no strike of which a third is random shows where a clean one leads.
    Slide: {
        "num_envs": 8,
        "gamma": 0.98,
        "random_eps": (0.0, 0.3),
        "noise_eps": 0.1,
        "relative_inputs": "fine",
        "augmentation": "mirror",
        "desired_ratio": 0.5,
        "batch_size": 512,
        "updates_per_step": 0.2,
        "target_interval": 10,
        "action_l2": 0.0,
        "anneal_lr": True,
        "total_steps": 1_000_000,
        "eval_interval": 25_000,
    },
    # Seldom lifted by chance: half of the episodes begin with the cube in the hand.
    PickAndPlace: {
        **OBJECT,
        "relative_inputs": "fine",
        "start_at_object": 0.5,
        "anneal_lr": True,
        "total_steps": 200_000,
        "eval_interval": 10_000,
    },
    # A stack is many steps, and seldom done by a hand that acts at random: most
    # episodes begin in its course, and each cube has a hindsight of its own.
    Stack: {
        **OBJECT,
        "gamma": 0.98,
        "random_eps": (0.0, 0.5),
        "relative_inputs": "fine",
        "start_at_object": 0.75,
        "her": "parts",
        "anneal_lr": True,
        "total_steps": 1_000_000,
        "eval_interval": 20_000,
    },
    # By imitation; not yet learned from rewards. A firm grasp and one in which the cube
    # swings are tenths of a millimetre apart.
    Flip: {
        **OBJECT,
        "relative_inputs": "fine",
        "fine_fingers": True,
        "batch_size": 512,
        "total_steps": 1_000_000,
    },
    Drawer: {**OBJECT, "anneal_lr": True, "total_steps": 20_000},
    # By imitation; not yet known to work without demonstrations.
    PegInsertion: {
        **OBJECT,
        "relative_inputs": "fine",
        "anneal_lr": True,
        "total_steps": 200_000,
        "eval_interval": 10_000,
    },
}


def find_recipe(env_id: str) -> dict[str, Any]:
    """The recipe for the task of an id; empty if there is none.

    Raises:
        ValueError: The id is unknown.
    """
    registration = find_registration(env_id)
    recipe = RECIPES.get(type(registration.make_task()), {})
    if registration.make_robot().control_type == "ee":
        return recipe
    return {k: x for k, x in recipe.items() if k not in END_EFFECTOR_OPTIONS}


def find_changes(args: Any, default: Any) -> dict[str, Any]:  # noqa: ANN401 (dataclasses)
    """The options that make another way to train of a preset's, for plots' labels."""
    ours, others = asdict(args), asdict(default)
    plain = PLAIN_OPTIONS
    if ours.get("anneal_lr"):  # by when the learning rate has fallen
        plain = plain - {"total_steps"}
    return {k: x for k, x in ours.items() if x != others[k] and k not in plain}
