"""Recipes: the options of ``train --preset tuned`` for each task.

Options that a recipe leaves out have the default, which is the panda-gym paper's. An
option on the command line overrides the recipe.
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

# Shared by all tasks with objects.
OBJECT: dict[str, Any] = {
    "num_envs": 8,
    "gamma": 0.95,
    "random_eps": (0.3, 1.0),
    "relative_inputs": "coarse",
    "augmentation": "mirror-shift",
    "eval_interval": 5_000,
}
# Options that do not make another way to train, so not another line in a plot.
PLAIN_OPTIONS = {
    *("algo", "seed", "total_steps", "eval_interval"),
    *("out", "resume", "device", "video", "imports"),
}
# Options that need end-effector control.
END_EFFECTOR_OPTIONS = ("augmentation", "start_at_object")
RECIPES: dict[type[Task], dict[str, Any]] = {
    Reach: {"num_envs": 8, "gamma": 0.95, "relative_inputs": "coarse"},
    # The first environment takes no random actions, and the last one half of them. The
    # policy learns in half the steps that it needs with 30 to 100 %.
    Push: {**OBJECT, "random_eps": (0.0, 0.5), "total_steps": 100_000},
    # Goals out of reach are rarely achieved, so half of the hindsight goals are desired
    # goals of other transitions. The first environment takes no random actions: the
    # whole strike decides where the puck stops, and random actions spoil most strikes.
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
    # Random actions rarely lift the cube, so half of the episodes start with the cube
    # in the hand.
    PickAndPlace: {
        **OBJECT,
        "relative_inputs": "fine",
        "start_at_object": 0.5,
        "anneal_lr": True,
        "total_steps": 200_000,
        "eval_interval": 10_000,
    },
    # Random actions rarely stack cubes, so most episodes start in the middle of the
    # task, and each cube gets hindsight goals of its own.
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
    # For imitation; rewards alone have not solved the task. Tenths of a millimetre
    # separate a firm grasp from one in which the cube swings.
    Flip: {
        **OBJECT,
        "relative_inputs": "fine",
        "fine_fingers": True,
        "batch_size": 512,
        "total_steps": 1_000_000,
    },
    Drawer: {**OBJECT, "anneal_lr": True, "total_steps": 20_000},
    # For imitation; not tested without demonstrations.
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
    """The options that differ from the default, for the labels of plots."""
    options, defaults = asdict(args), asdict(default)
    plain = PLAIN_OPTIONS
    if options.get("anneal_lr"):  # then the learning rate depends on the total steps
        plain = plain - {"total_steps"}
    return {k: x for k, x in options.items() if x != defaults[k] and k not in plain}
