"""Truncated quantile critics (arXiv 2005.04269), with torchrl's loss."""

from typing import Any

from tensordict.nn import TensorDictModule
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import LossModule, TQCLoss

from torch_panda.learning.agents.sac import SAC

NUM_QUANTILES = 25  # quantiles of each critic
NUM_DROPPED = 2  # highest quantiles of each critic that the target leaves out


class TQC(SAC):
    """SAC with critics that learn quantiles of the return.

    The target of the critics leaves out the highest quantiles, so that values are not
    overestimated.
    """

    critic_outputs = NUM_QUANTILES

    def make_loss(
        self,
        actor: ProbabilisticActor,
        critic: TensorDictModule,
        **options: Any,  # noqa: ANN401 (options of the loss)
    ) -> LossModule:
        """Make torchrl's loss module for actor and critics."""
        num_dropped = NUM_DROPPED if self.hp.double_q else 0
        return TQCLoss(
            actor, critic, top_quantiles_to_drop_per_net=num_dropped, **options
        )
