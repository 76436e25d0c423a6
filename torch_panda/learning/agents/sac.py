"""Soft actor-critic (arXiv 1801.01290), with torchrl's loss."""

from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, TanhNormal
from torchrl.objectives import SACLoss, SoftUpdate

from torch_panda.learning.agents.base import TAU, Agent
from torch_panda.learning.hyperparameters import Hyperparameters
from torch_panda.learning.networks import make_mlp
from torch_panda.learning.spaces import Spaces
from torch_panda.learning.transitions import Transitions

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
        self.soft_update = SoftUpdate(self.loss, tau=TAU)
        noise = [self.random_points()] if hp.exploration == "points" else []
        self.assemble(actor, noise, trained=list(self.loss.parameters()))

    def backward(
        self, state: Tensor, rows: Transitions, num_demos: int
    ) -> dict[str, Tensor]:
        """Compute torchrl's losses and their gradients; see `Agent.backward`.

        Demonstrations count as ordinary transitions.
        """
        next_state = self.normalizer(rows.next_observation, rows.goal)
        flags = {"terminated": rows.terminated, "done": rows.terminated}
        after_step = {"normalized": next_state, "reward": rows.reward, **flags}
        batch = {"normalized": state, "action": rows.action, "next": after_step}
        torchrl_losses = self.loss(TensorDict(batch, [len(state)]))
        losses = {
            "critic_loss": torchrl_losses["loss_qvalue"],
            "actor_loss": torchrl_losses["loss_actor"],
        }
        (losses["critic_loss"] + losses["actor_loss"]).backward()
        return losses

    def move_targets(self) -> None:
        """Move the target networks towards the online networks, by the fraction TAU."""
        self.soft_update.step()
