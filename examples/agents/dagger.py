"""Imitation of an expert who watches the policy act (DAgger, arXiv 1011.0686)."""

from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from agents.base import Agent
from agents.hyperparameters import Hyperparameters
from agents.networks import make_mlp, make_noise
from agents.transitions import Transitions
from torch_panda import RobotTaskEnv


class DAgger(Agent):
    """An actor alone, regressed to the actions of its transitions.

    These are to be what the expert would have done in the states that the actor's own
    actions led to: it learns what to do after its mistakes.
    """

    def __init__(self, env: RobotTaskEnv, hp: Hyperparameters) -> None:
        super().__init__(env, hp)
        net = make_mlp(self.state_size, self.action_size, layer_norm=hp.layer_norm)
        self.actor = nn.Sequential(net, nn.Tanh())
        self.assemble(
            TensorDictModule(self.actor, ["normalized"], ["action"]),
            make_noise(env, hp),
            trained=list(self.actor.parameters()),
        )

    def backward(
        self, state: Tensor, next_state: Tensor, rows: Transitions, num_demos: int
    ) -> dict[str, Tensor]:
        """Descend the mean squared difference; demonstrations are as any others."""
        loss = nn.functional.mse_loss(self.actor(state), rows.action)
        loss.backward()
        return {"actor_loss": loss}

    def move_targets(self) -> None:
        """There are none."""
