"""Gymnasium interfaces: one environment and a vector of environments."""

from torch_panda.gymnasium_envs.goal_env import GoalEnv
from torch_panda.gymnasium_envs.goal_vector_env import GoalVectorEnv

__all__ = ["GoalEnv", "GoalVectorEnv"]
