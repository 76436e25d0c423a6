"""Recipes: the options of the presets of ``train`` for each task.

``--preset recipe`` has one set of hyperparameters for all tasks, also for those of a
user. ``--preset tuned`` is tuned for each shipped task. ``--preset sample-efficient``
learns them in fewer environment steps, with more gradient steps per environment step.

An option that is not in a recipe keeps its default, the value of the preset "paper".
An option on the command line overrides the recipe.
"""

import functools
from dataclasses import asdict
from typing import Any

from torch_panda.learning.environments import GoalEnv, is_from_gymnasium
from torch_panda.learning.environments.geometry import declares_layout, find_layout
from torch_panda.learning.environments.gym_goal_env import GymGoalEnv
from torch_panda.registry import Registration, find_registration
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

# The preset "recipe": the same for all tasks. `derive_options` adds what follows from
# the task.
RECIPE: dict[str, Any] = {
    "num_envs": 8,
    "updates_per_step": 2.0,
    "network": "layer-norm",
    "exploration": "points",
    # One of the environments takes no random actions.
    "random_eps": (0.0, 0.5),
    # "fine" inputs fit tasks in which millimetres count, and do no harm in others.
    "relative_inputs": "fine",
    # Goals that the policy is asked for, but rarely achieves, are learned sooner if
    # some of the hindsight goals are such goals.
    "desired_ratio": 0.3,
    "action_l2": 0.1,
    "ema_rate": 0.003,
    "total_steps": 40_000,
    "stop_when_solved": True,
}
# All presets but "paper" store this fraction of the rollouts in which the achieved goal
# does not change (see `buffers.has_moved`).
KEEP_UNMOVED = 0.1
RECIPE["keep_unmoved"] = KEEP_UNMOVED
# The preset "offline", for all algorithms that learn from a data set. As in OGBench,
# but with smaller networks and batches.
OFFLINE: dict[str, Any] = {
    "offline": True,
    "algo": "gcivl",
    "gamma": 0.99,
    "network": "gelu",
    "relative_inputs": "fine",
    "num_envs": 16,
    "updates_per_step": 1.0,  # an iteration is one gradient step
    "total_steps": 100_000,
    "eval_interval": 10_000,
}
# The policy looks ahead over this part of an episode: 20 of 50 steps (gamma 0.95).
HORIZON = 0.4

# Shared by the recipes of all tasks with objects but Slide.
OBJECT: dict[str, Any] = {
    "num_envs": 8,
    "gamma": 0.95,
    "random_eps": (0.3, 1.0),
    "relative_inputs": "coarse",
    "augmentation": "mirror-shift",
    "eval_interval": 5_000,
}
# Options that `find_changes` leaves out: the algorithm, which the labels of plots name
# anyway, and options that may differ between the runs that one line of a plot
# summarizes.
UNPLOTTED_OPTIONS = {
    *("algo", "seed", "total_steps", "eval_interval"),
    *("out", "resume", "device", "video", "logger", "imports", "stop_when_solved"),
}
# Options that need the control type "ee". `find_recipe` drops them for other types.
END_EFFECTOR_OPTIONS = ("augmentation", "start_at_object")
RECIPES: dict[type[Task], dict[str, Any]] = {
    Reach: {"num_envs": 8, "gamma": 0.95, "relative_inputs": "coarse"},
    # The first environment takes no random actions, and the last one takes 50 %. If
    # they take 30 and 100 %, as in `OBJECT`, learning takes 1.4 to 1.8 times as long.
    Push: {**OBJECT, "random_eps": (0.0, 0.5), "total_steps": 100_000},
    # The goals are out of the arm's reach and rarely achieved, so half of the hindsight
    # goals are desired goals of random transitions. There are few random actions,
    # because a single one during a strike changes where the puck stops.
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
    # For training with demonstrations: without them no training has solved the task. A
    # tenth of a millimetre separates a firm grasp from one that lets the object swing.
    # With ``fine_fingers``, an action of the fingers is the third power of the
    # network's output, so small finger movements are more precise.
    Flip: {
        **OBJECT,
        "relative_inputs": "fine",
        "fine_fingers": True,
        "batch_size": 512,
        "total_steps": 1_000_000,
    },
    Drawer: {**OBJECT, "anneal_lr": True, "total_steps": 20_000},
    # For training with demonstrations; not tested without them.
    PegInsertion: {
        **OBJECT,
        "relative_inputs": "fine",
        "anneal_lr": True,
        "total_steps": 200_000,
        "eval_interval": 10_000,
    },
}

# Changes to `RECIPES` for ids in which success ends an episode, such as -v3. There, a
# puck that slides through its goal succeeds. So Slide needs fewer environment steps.
# The recipe takes more gradient steps per environment step, and explores towards random
# points.
CHANGES_IF_SUCCESS_ENDS: dict[type[Task], dict[str, Any]] = {
    Slide: {
        "exploration": "points",
        "network": "layer-norm",
        "gamma": 0.95,
        "batch_size": 256,
        "target_interval": 1,
        "updates_per_step": 0.5,
        "total_steps": 240_000,
        "eval_interval": 10_000,
    },
}
# The changes that "sample-efficient" makes to the recipe of any task. Push has less
# success after 20,000 steps if one of the first three is left out. The fourth keeps the
# learning rate constant even if the task's recipe anneals it.
SAMPLE_EFFICIENT: dict[str, Any] = {
    "exploration": "points",
    "updates_per_step": 2.0,
    "network": "layer-norm",
    "anneal_lr": False,
}
# Further changes that "sample-efficient" makes to single tasks. On its way to random
# points, the hand lifts the cube of PickAndPlace often enough, so no episode needs to
# start with the cube in the hand.
SAMPLE_EFFICIENT_CHANGES: dict[type[Task], dict[str, Any]] = {
    Push: {"total_steps": 20_000, "eval_interval": 2_500},
    PickAndPlace: {
        "start_at_object": 0.0,
        "random_eps": (0.0, 0.5),
        "action_l2": 0.1,
        "ema_rate": 0.003,
        "total_steps": 40_000,
        "eval_interval": 5_000,
    },
    # For training with special starts, or with demonstrations and without special
    # starts: `--demos FILE --start-at-object 0`.
    Stack: {
        "action_l2": 0.1,
        "ema_rate": 0.003,
        "total_steps": 100_000,
        "eval_interval": 5_000,
    },
}
# Changes to SAMPLE_EFFICIENT_CHANGES for ids in which success ends an episode, such as
# -v3. If training episodes of Push ended at success too, the cube would rarely be
# beyond its goal in training. A policy that misses a goal by one or two centimetres
# would then not turn back. A small penalty on actions makes the policy faster. In
# PickAndPlace-v3, fingers and cube have less friction, and random grasps rarely hold
# the cube.
SAMPLE_EFFICIENT_IF_SUCCESS_ENDS: dict[type[Task], dict[str, Any]] = {
    Push: {
        "continue_after_success": True,
        "action_l2": 0.1,
        "total_steps": 40_000,
        "eval_interval": 5_000,
    },
    PickAndPlace: {
        "start_at_object": 0.5,
        "action_l2": 1.0,
        "total_steps": 60_000,
        "eval_interval": 10_000,
    },
}


def derive_options(registration: Registration) -> dict[str, Any]:
    """Derive options of the preset "recipe" from what a task and a robot declare."""
    task, robot = registration.make_task(), registration.make_robot()
    steps = registration.max_episode_steps or task.max_episode_steps
    options: dict[str, Any] = {"gamma": round(1 - 1 / (HORIZON * steps), 4)}
    if declares_layout(task) and robot.control_type == "ee":
        options["augmentation"] = "mirror-shift"
    if robot.control_type not in ("ee", "joints"):
        options["exploration"] = "actions"
    num_objects, rest = divmod(task.goal_dim, 3)
    if num_objects > 1 and not rest:
        options["her"] = "parts"  # each object on its own
    return options


@functools.cache
def derive_gym_options(env_id: str) -> dict[str, Any]:
    """Derive options of the preset "recipe" for an environment of Gymnasium."""
    with GymGoalEnv(env_id, num_envs=4, seed=0) as env:
        return find_options(env)


def find_options(env: GoalEnv) -> dict[str, Any]:
    """Find options of the preset "recipe" for environments that declare nothing.

    They play some episodes with random actions.
    """
    hand, geometry = find_layout(env)
    gamma = 1 - 1 / (HORIZON * env.max_episode_steps)
    options: dict[str, Any] = {"gamma": round(gamma, 4)}
    if hand is None:
        options["exploration"] = "actions"
    if len(geometry.goal_positions) > 1:
        options["her"] = "parts"
    return options


def find_recipe(env_id: str, preset: str = "tuned") -> dict[str, Any]:
    """Return the recipe of a preset for the task of an id.

    Args:
        env_id: Id of an environment, shipped or registered.
        preset: "recipe", "tuned", or "sample-efficient".

    Returns:
        The options that the recipe sets, by name. For a user's own task, "tuned" sets
        none, and "sample-efficient" sets those in `SAMPLE_EFFICIENT`.

    Raises:
        ValueError: The id is unknown.
    """
    if is_from_gymnasium(env_id):
        if preset != "recipe":
            raise ValueError(
                f"the preset {preset} is tuned for the tasks of torch_panda: {env_id} "
                "needs --preset recipe or paper"
            )
        return RECIPE | derive_gym_options(env_id)
    registration = find_registration(env_id)
    if preset == "recipe":
        return RECIPE | derive_options(registration)
    task = type(registration.make_task())
    recipe = RECIPES.get(task, {})
    if registration.terminate_on_success:
        recipe = recipe | CHANGES_IF_SUCCESS_ENDS.get(task, {})
    if preset == "sample-efficient":
        recipe = recipe | SAMPLE_EFFICIENT | SAMPLE_EFFICIENT_CHANGES.get(task, {})
        if registration.terminate_on_success:
            recipe = recipe | SAMPLE_EFFICIENT_IF_SUCCESS_ENDS.get(task, {})
    if registration.make_robot().control_type == "ee":
        return recipe
    return {
        name: value
        for name, value in recipe.items()
        if name not in END_EFFECTOR_OPTIONS
    }


def find_changes(args: Any, default: Any) -> dict[str, Any]:  # noqa: ANN401 (dataclasses)
    """Return the options that differ from their defaults, for the labels of plots.

    Args:
        args: Options of a run.
        default: Default options, of the same dataclass.
    """
    options, defaults = asdict(args), asdict(default)
    unplotted = UNPLOTTED_OPTIONS
    if options.get("anneal_lr"):  # the learning rate depends on the total steps
        unplotted = unplotted - {"total_steps"}
    return {
        name: value
        for name, value in options.items()
        if value != defaults[name] and name not in unplotted
    }
