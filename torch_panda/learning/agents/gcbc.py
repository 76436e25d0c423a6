"""Goal-conditioned behavioural cloning, GCBC.

GCBC is one iteration of GCSL (arXiv 1912.06088) on fixed data.

The policy imitates every action of the data, given a goal that its episode achieves
later.
"""

from torch import Tensor

from torch_panda.learning.agents.base import Agent
from torch_panda.learning.agents.batch import Batch
from torch_panda.learning.agents.hyperparameters import Hyperparameters
from torch_panda.learning.agents.networks import make_mlp
from torch_panda.learning.agents.offline_losses import (
    OGBENCH_RATES,
    log_prob,
    make_mean_policy,
)
from torch_panda.learning.environments.spaces import Spaces


class GCBC(Agent):
    """A policy pi(a | s, g) that imitates."""

    learning_rate, tau = OGBENCH_RATES

    def __init__(self, spaces: Spaces, hp: Hyperparameters) -> None:
        super().__init__(spaces, hp)
        self.actor = make_mlp(self.state_size, spaces.action_size, hp.network)
        self.assemble(make_mean_policy(self.actor))

    def losses(self, b: Batch) -> dict[str, Tensor]:
        """Maximise log pi(a_t | s_t, g) with g from {s_t+1, ..., s_T} (section 3)."""
        mean = self.actor(self.normalizer(b.s, b.g_actor))
        return {"actor_loss": -log_prob(mean, b.a).mean()}
