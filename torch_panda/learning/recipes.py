"""The recipe: one set of hyperparameters with which ``train`` learns any task.

Some options depend on the task. `derive_options` computes them from what the task
declares, and `find_options` from a few random episodes. An option that the recipe does
not name keeps its default, the value of the preset "paper". An option on the command
line overrides the recipe.
"""

import functools
from dataclasses import asdict
from typing import Any

from torch_panda.learning.environments import GoalEnv, is_from_gymnasium
from torch_panda.learning.environments.geometry import (
    find_parts,
    observes_hand_first,
    split_goal,
)
from torch_panda.learning.environments.gym_goal_env import GymGoalEnv
from torch_panda.learning.environments.spaces import follows_points, read_spaces
from torch_panda.registry import Registration, find_registration

# The same for all tasks. `derive_options` adds what follows from the task.
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
    # Most rollouts in which the achieved goal does not change teach nothing.
    "keep_unmoved": 0.1,
    "action_l2": 0.1,
    "ema_rate": 0.003,
    "total_steps": 40_000,
    "stop_when_solved": True,
}
# If goals have parts for several objects, each object is learned on its own. Otherwise
# a second object delays the learning of the first one, even if it has no goal.
EACH_OBJECT = {"her": "parts", "critics": "parts"}
# Random moves rarely bring several objects to their goals at once. Environments of
# Gymnasium cannot start in chosen states.
STARTS = {"start_at_reached": 0.75}
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

# Options that `find_changes` leaves out: the algorithm, which the labels of plots name
# anyway, and options that may differ between the runs that one line of a plot
# summarizes.
UNPLOTTED_OPTIONS = {
    *("algo", "seed", "total_steps", "eval_interval"),
    *("out", "resume", "device", "workers", "video", "logger", "imports"),
    "stop_when_solved",
}


def derive_options(registration: Registration) -> dict[str, Any]:
    """Derive options of the recipe from what a task and a robot declare."""
    task, robot = registration.make_task(), registration.make_robot()
    gamma = derive_gamma(registration.max_episode_steps)
    options: dict[str, Any] = {"gamma": gamma}
    declared = find_parts(robot, task)
    if declared is not None and robot.control_type == "ee":
        options["augmentation"] = "mirror-shift"
    if not follows_points(
        robot.action_dim - robot.has_free_gripper,
        knows_hand=robot.control_type == "ee" and observes_hand_first(robot),
        moves_joints=robot.control_type == "joints",
    ):
        options["exploration"] = "actions"
    if declared is None:
        has_several_objects = len(split_goal(task.goal_dim)) > 1
    else:
        quantities = [part.quantity for part, _ in declared[1]]
        has_several_objects = len(quantities) > 1 and {*quantities} == {"position"}
    if has_several_objects:
        options |= EACH_OBJECT | STARTS
    return options


def derive_gamma(steps: int) -> float:
    """Derive the discount from the number of steps of an episode."""
    return round(1 - 1 / max(HORIZON * steps, 2), 4)


@functools.cache
def derive_gym_options(env_id: str) -> dict[str, Any]:
    """Derive options of the recipe for an environment of Gymnasium."""
    with GymGoalEnv(env_id, num_envs=4, seed=0) as env:
        return find_options(env)


def find_options(env: GoalEnv) -> dict[str, Any]:
    """Find options of the recipe for environments that declare nothing.

    They play some episodes with random actions.
    """
    spaces = read_spaces(env, finds_layout=True)
    options: dict[str, Any] = {"gamma": derive_gamma(env.max_episode_steps)}
    if not spaces.follows_points:
        options["exploration"] = "actions"
    if spaces.geometry is not None and len(spaces.geometry.goal_positions) > 1:
        options |= EACH_OBJECT
    return options


def find_recipe(env_id: str) -> dict[str, Any]:
    """Return the options that the recipe sets for the task of an id, by name.

    Args:
        env_id: Id of an environment: shipped, registered, or of Gymnasium.

    Raises:
        ValueError: The id is unknown.
    """
    if is_from_gymnasium(env_id):
        return RECIPE | derive_gym_options(env_id)
    return RECIPE | derive_options(find_registration(env_id))


def find_changes(args: Any, default: Any) -> dict[str, Any]:  # noqa: ANN401 (dataclasses)
    """Return the options that differ from their defaults, for the labels of plots.

    Args:
        args: Options of a run.
        default: Default options, of the same dataclass.
    """
    options, defaults = asdict(args), asdict(default)
    return {
        name: value
        for name, value in options.items()
        if value != defaults[name] and name not in UNPLOTTED_OPTIONS
    }
