"""Goal-conditioned behavioural cloning, GCBC.

GCBC is one iteration of GCSL (arXiv 1912.06088) on fixed data.

The policy imitates every action of the data, given a goal that its episode achieves
later.
"""

from tensordict import TensorDictBase
from torch import Tensor

from torch_panda.learning.offline.base import (
    Actor,
    Batch,
    OfflineAgent,
    OfflineHyperparameters,
    log_prob,
)
from torch_panda.learning.spaces import Spaces


class GCBC(OfflineAgent):
    """A policy pi(a | s, g) that imitates."""

    def __init__(self, spaces: Spaces, hp: OfflineHyperparameters) -> None:
        super().__init__(spaces, hp)
        self.actor = Actor(self.normalizer, spaces.action_size)
        self.assemble(self.actor)

    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Maximise log pi(a_t | s_t, g) with g from {s_t+1, ..., s_T} (section 3)."""
        b = Batch.from_tensordict(batch)
        return {"actor_loss": -log_prob(self.actor(b.s, b.g_actor), b.a).mean()}
