"""The environments as Gymnasium goal environments, single and vectorised."""

from torch_panda.gymnasium_envs.goal_env import GoalEnv
from torch_panda.gymnasium_envs.goal_vector_env import GoalVectorEnv

__all__ = ["GoalEnv", "GoalVectorEnv"]
