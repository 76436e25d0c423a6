"""The environments as Gymnasium goal environments, single and vectorised."""

import warnings

import gymnasium

from torch_panda.gymnasium_envs.goal_env import GoalEnv
from torch_panda.gymnasium_envs.goal_vector_env import GoalVectorEnv
from torch_panda.registry import ENV_IDS, max_episode_steps

__all__ = ["GoalEnv", "GoalVectorEnv", "register_envs"]


def register_envs() -> None:
    """Register ``torch_panda/{id}`` for every id, for ``make`` and ``make_vec``.

    ``gymnasium.make`` truncates with its own ``TimeLimit``, so that its argument
    ``max_episode_steps`` works as for any other environment.
    """
    # To Gymnasium -v3 is the successor of -v1; here they are different tasks.
    warnings.filterwarnings(
        "ignore", r".*torch_panda/Panda\w+-v1 is out of date", DeprecationWarning
    )
    for env_id in ENV_IDS:
        gymnasium.register(
            f"torch_panda/{env_id}",
            entry_point="torch_panda.gymnasium_envs:GoalEnv",
            vector_entry_point="torch_panda.gymnasium_envs:GoalVectorEnv",
            max_episode_steps=max_episode_steps(env_id),
            kwargs={"env": env_id},
        )
