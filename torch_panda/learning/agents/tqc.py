"""Truncated quantile critics (arXiv 2005.04269), over torchrl's loss."""

from typing import Any

from tensordict.nn import TensorDictModule
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import LossModule, TQCLoss

from torch_panda.learning.agents.sac import SAC

NUM_QUANTILES = 25  # quantiles of each critic
DROPPED = 2  # highest quantiles of each critic that the target leaves out


class TQC(SAC):
    """SAC whose critics learn quantiles of the return; targets drop the highest."""

    critic_outputs = NUM_QUANTILES

    def make_loss(
        self,
        actor: ProbabilisticActor,
        critic: TensorDictModule,
        **options: Any,  # noqa: ANN401 (options of the loss)
    ) -> LossModule:
        """Make the losses of actor and critics."""
        dropped = DROPPED if self.hp.double_q else 0
        return TQCLoss(actor, critic, top_quantiles_to_drop_per_net=dropped, **options)
