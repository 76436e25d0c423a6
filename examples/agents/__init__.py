"""DDPG, TD3, SAC and TQC for goal-conditioned tasks: a class an algorithm."""

import torch

from agents.base import Agent
from agents.ddpg import DDPG
from agents.hyperparameters import Hyperparameters
from agents.sac import SAC
from agents.td3 import TD3
from agents.tqc import TQC
from torch_panda import RobotTaskEnv

AGENTS: dict[str, type[Agent]] = {"ddpg": DDPG, "td3": TD3, "sac": SAC, "tqc": TQC}

__all__ = ["AGENTS", "DDPG", "SAC", "TD3", "TQC", "Agent", "Hyperparameters"]


def make_agent(env: RobotTaskEnv, hp: Hyperparameters) -> Agent:
    """An untrained agent on the environment's device."""
    with torch.device(env.device or "cpu"):
        return AGENTS[hp.algo](env, hp)
