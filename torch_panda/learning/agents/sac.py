"""Soft actor-critic (arXiv 1801.01290), with torchrl's loss."""

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, TanhNormal
from torchrl.objectives import SACLoss

from torch_panda.learning.agents.base import Agent
from torch_panda.learning.agents.batch import Batch
from torch_panda.learning.agents.exploration import RandomPointModule
from torch_panda.learning.agents.hyperparameters import Hyperparameters
from torch_panda.learning.agents.networks import make_mlp
from torch_panda.learning.environments.spaces import Spaces

ALPHA = 0.2  # entropy coefficient, which is not trained


class SAC(Agent):
    """A stochastic policy that maximises the value of critics and its entropy."""

    def __init__(self, spaces: Spaces, hp: Hyperparameters) -> None:
        super().__init__(spaces, hp)
        inputs = self.state_size
        net = make_mlp(inputs, 2 * spaces.action_size, hp.network)
        parameters = nn.Sequential(net, NormalParamExtractor())
        actor = ProbabilisticActor(
            TensorDictModule(parameters, ["normalized"], ["loc", "scale"]),
            in_keys=["loc", "scale"],
            distribution_class=TanhNormal,
            # By default, every call would copy them from the CPU.
            distribution_kwargs={"low": torch.tensor(-1.0), "high": torch.tensor(1.0)},
        )
        critic = TensorDictModule(
            make_mlp(inputs + spaces.action_size, 1, hp.network),
            ["normalized", "action"],
            ["state_action_value"],
        )
        self.loss = SACLoss(
            actor,
            critic,
            loss_function="l2",
            num_qvalue_nets=2 if hp.double_q else 1,
            deactivate_vmap=True,  # faster on CPU
            alpha_init=ALPHA,
            fixed_alpha=True,
            action_spec=spaces.action_spec(),
        )
        self.loss.make_value_estimator(gamma=self.gamma)
        # Reading this attribute registers a buffer, which every saved state must have.
        _ = self.loss.target_entropy
        online = self.loss.qvalue_network_params
        targets = self.loss.target_qvalue_network_params
        for key in online.keys(True, True):
            self._online.append(online[key])
            self._targets.append(targets[key])
        noise = [RandomPointModule(spaces, hp)] if hp.exploration == "points" else []
        self.assemble(actor, noise)

    def losses(self, b: Batch) -> dict[str, Tensor]:
        """Torchrl's losses. Demonstrations count as ordinary transitions."""
        state = self.normalizer(b.s, b.g)
        next_state = self.normalizer(b.s_next, b.g)
        ends, reward = b.ends.unsqueeze(-1), b.r.unsqueeze(-1)
        flags = {"terminated": ends, "done": ends}
        after_step = {"normalized": next_state, "reward": reward, **flags}
        batch = {"normalized": state, "action": b.a, "next": after_step}
        losses = self.loss(TensorDict(batch, [len(state)]))
        return {
            "critic_loss": losses["loss_qvalue"],
            "actor_loss": losses["loss_actor"],
        }
