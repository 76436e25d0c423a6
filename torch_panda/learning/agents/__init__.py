"""Agents for goal-conditioned tasks: DDPG, TD3, SAC and CRL."""

import torch

from torch_panda.learning.agents.base import Agent
from torch_panda.learning.agents.crl import CRL
from torch_panda.learning.agents.ddpg import DDPG
from torch_panda.learning.agents.sac import SAC
from torch_panda.learning.agents.td3 import TD3
from torch_panda.learning.environments import GoalEnv
from torch_panda.learning.hyperparameters import Hyperparameters
from torch_panda.learning.spaces import read_spaces

AGENTS: dict[str, type[Agent]] = {"ddpg": DDPG, "td3": TD3, "sac": SAC, "crl": CRL}

__all__ = ["AGENTS", "CRL", "DDPG", "SAC", "TD3", "Agent", "Hyperparameters"]


def make_agent(env: GoalEnv, hp: Hyperparameters) -> Agent:
    """Make an untrained agent on the device of the environments that it will explore.

    If the agent needs a layout that the task does not declare, the environments play
    some episodes with random actions, from which it is found.

    Raises:
        ValueError: The hyperparameters do not fit the environment.
    """
    with torch.device(env.device or "cpu"):
        finds_layout = hp.relative_inputs != "none" or hp.exploration == "points"
        return AGENTS[hp.algo](read_spaces(env, finds_layout=finds_layout), hp)
