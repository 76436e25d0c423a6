"""Deep deterministic policy gradient (arXiv 1509.02971), with the details of Baselines.

The losses are written in plain torch. With torchrl's DDPGLoss, a gradient step takes a
sixth longer.
"""

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.objectives import hold_out_net

from torch_panda.learning.agents.base import Agent
from torch_panda.learning.agents.batch import Batch
from torch_panda.learning.agents.exploration import make_noise
from torch_panda.learning.agents.hyperparameters import Hyperparameters
from torch_panda.learning.agents.networks import Ensemble, PartCritics, make_mlp
from torch_panda.learning.environments.spaces import Spaces

# Weight of the squared inputs of the actor's tanh in its loss. Without this penalty the
# inputs can grow until the gradient of the tanh vanishes, which ruined policies of
# Slide (arXiv 1707.01495, appendix A).
SATURATION_L2 = 0.01
# Weight of imitation in the actor's loss (Nair et al., arXiv 1709.10089).
BC_WEIGHT = 20.0


class DDPG(Agent):
    """A deterministic actor that maximises the value of a critic.

    The subclass `TD3` changes the class attributes.
    """

    num_critics = 1

    def __init__(self, spaces: Spaces, hp: Hyperparameters) -> None:
        super().__init__(spaces, hp)
        inputs, action_size = self.state_size, spaces.action_size
        self.actor = nn.Sequential(make_mlp(inputs, action_size, hp.network), nn.Tanh())
        if hp.critics == "parts":
            weights = self.normalizer.part_weights()
            self.critics: Ensemble = PartCritics(weights, action_size, hp.network)
        else:
            self.critics = Ensemble(inputs + action_size, hp.network, self.num_critics)
        self.target_actor = self.make_target(self.actor)
        self.target_critics = self.make_target(self.critics)
        actor = TensorDictModule(self.actor, ["normalized"], ["action"])
        self.assemble(actor, make_noise(spaces, hp))

    def target_action(self, next_state: Tensor) -> Tensor:
        """Choose the actions whose values are the target of the critics.

        Args:
            next_state: States after the environment's step, (n, state size).

        Returns:
            Actions, (n, action size).
        """
        return self.target_actor(next_state)

    def losses(self, b: Batch) -> dict[str, Tensor]:
        """The losses of critics and actor."""
        state = self.normalizer(b.s, b.g)
        with torch.no_grad():
            next_state = self.normalizer(b.s_next, b.g)
            next_action = self.target_action(next_state)
            next_value = self.target_critics.target_value(next_state, next_action)
            # Of one row for all critics, or of one for each part.
            target = b.r.movedim(-1, 0) + self.gamma * next_value * ~b.ends
            if self.min_return is not None:
                target.clamp_(self.min_return, 0.0)
        values = self.critics(state, b.a)
        squared_errors = [
            nn.functional.mse_loss(value, row)
            for value, row in zip(values, target.expand_as(values), strict=True)
        ]
        losses = {"critic_loss": torch.stack(squared_errors).sum()}
        if self.updates % self.actor_interval == 0:
            losses["actor_loss"] = self.actor_loss(b, state)
        return losses

    def actor_loss(self, b: Batch, state: Tensor) -> Tensor:
        """Maximise the value, and imitate demonstrations.

        Args:
            b: The batch.
            state: States before the environment's step, (n, state size).
        """
        before_tanh = self.actor[0](state)
        action = before_tanh.tanh()
        with hold_out_net(self.critics):
            value = self.critics.policy_value(state, action)
        penalty = action_penalty(before_tanh, action, self.hp.action_l2)
        loss = penalty - value.mean()
        if b.num_demos:
            # Imitate only demonstrated actions that the critic prefers (the Q filter).
            demos = slice(-b.num_demos, None)
            with torch.no_grad():
                demo_value = self.critics.policy_value(state[demos], b.a[demos])
            is_preferred = (demo_value > value[demos]).unsqueeze(-1)
            squared_errors = (action - b.a)[demos].square()
            imitation_loss = (squared_errors * is_preferred).mean()
            loss = loss + BC_WEIGHT * imitation_loss
        return loss


def action_penalty(before_tanh: Tensor, action: Tensor, action_l2: float) -> Tensor:
    """Penalty on large actions in an actor's loss, a scalar.

    Args:
        before_tanh: Inputs of the actor's tanh, (n, action size).
        action: Its outputs, (n, action size).
        action_l2: Weight of the mean squared action.
    """
    penalty = action_l2 * action.square().mean()
    return penalty + SATURATION_L2 * before_tanh.square().mean()
