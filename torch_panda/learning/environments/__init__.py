"""Environments to learn in: those of torch_panda, or of Gymnasium with goals."""

from typing import Any, TypeAlias

import gymnasium

from torch_panda.envs import RobotTaskEnv
from torch_panda.learning.environments.gym_goal_env import GymGoalEnv
from torch_panda.registry import (
    GYMNASIUM_PREFIX,
    find_registration,
    is_registered,
    make,
    max_episode_steps,
)

GoalEnv: TypeAlias = RobotTaskEnv | GymGoalEnv
"""The environments in which agents learn.

From Python, `torch_panda.learning.training.Run` also takes another `EnvBase` of torchrl
that has a batch size [n], the entries ``observation``, ``achieved_goal``,
``desired_goal``, ``success`` and ``reward``, and the attributes ``max_episode_steps``,
``terminate_on_success`` and ``compute_reward`` of `GymGoalEnv`. Rewards of -1 and 0 are
learned sooner if it also has ``has_sparse_reward``."""

# Values of the options of `torch_panda.make` that change nothing.
_NEUTRAL: tuple[object, ...] = (None, {}, "exact")


def is_from_gymnasium(env_id: str) -> bool:
    """Whether an id is one of Gymnasium, and not of torch_panda.

    Raises:
        ValueError: The id is unknown.
    """
    if is_registered(env_id):
        return False
    if env_id.startswith(GYMNASIUM_PREFIX):
        find_registration(env_id)  # raises
    if env_id not in gymnasium.registry:
        try:
            find_registration(env_id)
        except ValueError as error:
            raise ValueError(
                f"{error}; an id of Gymnasium needs the module that registers it, such "
                "as --import gymnasium_robotics"
            ) from None
    return True


def make_env(
    env_id: str,
    *,
    workers: int = 1,
    renders: bool = False,
    **options: Any,  # noqa: ANN401 (options of `make`)
) -> GoalEnv:
    """Make the environments of an id, of torch_panda or of Gymnasium.

    Args:
        env_id: The id.
        workers: Processes of a `GymGoalEnv`.
        renders: Whether a `GymGoalEnv` will render.
        **options: Arguments of `torch_panda.make`. A `GymGoalEnv` takes ``num_envs``,
            ``seed`` and ``device`` only.

    Raises:
        ValueError: The id is unknown, or an argument does not fit it.
        TypeError: An argument is unknown.
    """
    if not is_from_gymnasium(env_id):
        if workers != 1:
            raise ValueError(
                f"{env_id} is stepped by threads and needs no processes, got "
                f"workers={workers}: drop --workers"
            )
        return make(env_id, **options)
    accepted = {
        name: options.pop(name)
        for name in ("num_envs", "seed", "device")
        if name in options
    }
    if refused := [name for name, x in options.items() if x not in _NEUTRAL]:
        raise refusal(env_id, *refused)
    return GymGoalEnv(env_id, workers=workers, renders=renders, **accepted)


def refusal(env_id: str, *names: str) -> ValueError:
    """The error for options that an environment of Gymnasium cannot have."""
    return ValueError(
        f"{env_id} is an environment of Gymnasium, which has no {' or '.join(names)}"
    )


def episode_length(env_id: str) -> int:
    """Number of steps after which the episodes of an id are truncated.

    Raises:
        ValueError: The id is unknown, or its episodes have no time limit.
    """
    if is_from_gymnasium(env_id):
        limit = gymnasium.spec(env_id).max_episode_steps
        if limit is None:
            raise ValueError(f"{env_id} cannot be used: it has no max_episode_steps")
        return limit
    return max_episode_steps(env_id)
