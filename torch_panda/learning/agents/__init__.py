"""Agents for goal-conditioned tasks, one file per algorithm."""

import torch

from torch_panda.learning.agents.base import Agent
from torch_panda.learning.agents.crl import CRL, OfflineCRL
from torch_panda.learning.agents.ddpg import DDPG
from torch_panda.learning.agents.gcbc import GCBC
from torch_panda.learning.agents.gciql import GCIQL
from torch_panda.learning.agents.gciql_nstep import NStepGCIQL
from torch_panda.learning.agents.gcivl import GCIVL
from torch_panda.learning.agents.hiql import HIQL
from torch_panda.learning.agents.hyperparameters import Hyperparameters
from torch_panda.learning.agents.qrl import QRL
from torch_panda.learning.agents.sac import SAC
from torch_panda.learning.agents.td3 import TD3
from torch_panda.learning.environments import GoalEnv
from torch_panda.learning.environments.spaces import read_spaces

AGENTS: dict[str, type[Agent]] = {"ddpg": DDPG, "td3": TD3, "sac": SAC, "crl": CRL}
"""Agents that explore, by name."""
OFFLINE_AGENTS: dict[str, type[Agent]] = {
    "gcbc": GCBC,
    "gcivl": GCIVL,
    "gciql": GCIQL,
    "gciql-nstep": NStepGCIQL,
    "hiql": HIQL,
    "qrl": QRL,
    "crl": OfflineCRL,
}
"""Agents that learn from a data set, by name."""

__all__ = ["AGENTS", "OFFLINE_AGENTS", "Agent", "Hyperparameters"]


def find_agent(hp: Hyperparameters) -> type[Agent]:
    """Find the class of an algorithm.

    Raises:
        ValueError: The algorithm is unknown, does not learn offline, or only offline.
    """
    agents = OFFLINE_AGENTS if hp.offline else AGENTS
    if hp.algo in agents:
        return agents[hp.algo]
    if hp.offline:
        raise ValueError(
            f"--offline learns by {', '.join(OFFLINE_AGENTS)}, got --algo {hp.algo}: "
            "choose one of them, or leave out --offline"
        )
    if hp.algo in OFFLINE_AGENTS:
        raise ValueError(f"{hp.algo} learns offline: add --offline")
    raise ValueError(f"algo must be one of {', '.join(AGENTS)}, got {hp.algo!r}")


def make_agent(env: GoalEnv, hp: Hyperparameters) -> Agent:
    """Make an untrained agent on the device of the environments that it will explore.

    If the agent needs a layout that the task does not declare, the environments play
    some episodes with random actions, from which it is found.

    Raises:
        ValueError: The hyperparameters do not fit the environment.
    """
    with torch.device(env.device or "cpu"):
        finds_layout = hp.relative_inputs != "none" or hp.exploration == "points"
        return find_agent(hp)(read_spaces(env, finds_layout=finds_layout), hp)
