"""Deep deterministic policy gradient (arXiv 1509.02971), with the details of Baselines.

The losses are written in plain torch. With torchrl's DDPGLoss, a gradient step takes a
sixth longer.
"""

import copy

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from torch_panda.learning.agents.base import TAU, Agent
from torch_panda.learning.hyperparameters import Hyperparameters
from torch_panda.learning.networks import make_mlp
from torch_panda.learning.spaces import Spaces
from torch_panda.learning.transitions import Transitions

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
    actor_interval = 1  # gradient steps of the critics per gradient step of the actor

    def __init__(self, spaces: Spaces, hp: Hyperparameters) -> None:
        super().__init__(spaces, hp)
        inputs, action_size = self.state_size, spaces.action_size
        self.actor = nn.Sequential(make_mlp(inputs, action_size, hp.network), nn.Tanh())
        self.critics = nn.ModuleList(
            make_mlp(inputs + action_size, 1, hp.network)
            for _ in range(self.num_critics)
        )
        self.target_actor = copy.deepcopy(self.actor).requires_grad_(False)
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        self.actor_parameters = list(self.actor.parameters())
        # Parameters of the trained networks and, in the same order, of their targets.
        self.online: list[Tensor] = [*self.actor_parameters, *self.critics.parameters()]
        self.target: list[Tensor] = [
            *self.target_actor.parameters(),
            *self.target_critics.parameters(),
        ]
        self.assemble(
            TensorDictModule(self.actor, ["normalized"], ["action"]),
            self.action_noise(),
            trained=self.online,
        )

    def target_action(self, next_state: Tensor) -> Tensor:
        """Choose the actions whose values are the target of the critics.

        Args:
            next_state: States after the environment's step, (n, state size).

        Returns:
            Actions, (n, action size).
        """
        return self.target_actor(next_state)

    def backward(
        self, state: Tensor, rows: Transitions, num_demos: int
    ) -> dict[str, Tensor]:
        """Compute the losses of critics and actor, and their gradients.

        See `Agent.backward`.
        """
        with torch.no_grad():
            next_state = self.normalizer(rows.next_observation, rows.goal)
            next_action = self.target_action(next_state)
            next_values = [
                critic(next_state, next_action) for critic in self.target_critics
            ]
            next_value = torch.stack(next_values).amin(0)
            target = rows.reward + self.gamma * next_value * ~rows.terminated
            if self.min_return is not None:
                target.clamp_(self.min_return, 0.0)
        values = [critic(state, rows.action) for critic in self.critics]
        losses = [nn.functional.mse_loss(value, target) for value in values]
        critic_loss = torch.stack(losses).sum()
        critic_loss.backward()
        if self.updates % self.actor_interval:
            return {"critic_loss": critic_loss}

        before_tanh = self.actor[0](state)
        action = before_tanh.tanh()
        value = self.critics[0](state, action)
        penalty = action_penalty(before_tanh, action, self.hp.action_l2)
        actor_loss = penalty - value.mean()
        if num_demos:
            # Imitate only demonstrated actions that the critic prefers (the Q filter).
            is_preferred = (values[0] > value)[-num_demos:].detach()
            difference = (action - rows.action)[-num_demos:]
            imitation_loss = (difference.square() * is_preferred).mean()
            actor_loss = actor_loss + BC_WEIGHT * imitation_loss
        # Compute gradients for the actor only. The critics keep the gradients of their
        # own loss.
        actor_loss.backward(inputs=self.actor_parameters)
        return {"critic_loss": critic_loss, "actor_loss": actor_loss}

    def move_targets(self) -> None:
        """Move the target networks towards the online networks, by the fraction TAU."""
        with torch.no_grad():
            torch._foreach_lerp_(self.target, self.online, TAU)


def action_penalty(before_tanh: Tensor, action: Tensor, action_l2: float) -> Tensor:
    """Penalty on large actions in an actor's loss, a scalar.

    Args:
        before_tanh: Inputs of the actor's tanh, (n, action size).
        action: Its outputs, (n, action size).
        action_l2: Weight of the mean squared action.
    """
    penalty = action_l2 * action.square().mean()
    return penalty + SATURATION_L2 * before_tanh.square().mean()
