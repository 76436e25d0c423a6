"""Twin delayed DDPG (arXiv 1802.09477)."""

import torch
from torch import Tensor

from torch_panda.learning.agents.ddpg import DDPG
from torch_panda.learning.agents.hyperparameters import Hyperparameters
from torch_panda.learning.environments.spaces import Spaces

POLICY_NOISE = 0.2  # standard deviation of the noise on target actions
NOISE_CLIP = 0.5  # limit at which this noise is clipped


class TD3(DDPG):
    """DDPG with two critics, noise on target actions, and fewer steps of the actor.

    In the paper, the target networks move only together with the actor. Here they move
    after every gradient step, as in DDPG.
    """

    actor_interval = 2

    def __init__(self, spaces: Spaces, hp: Hyperparameters) -> None:
        self.num_critics = 2 if hp.double_q else 1
        super().__init__(spaces, hp)

    def target_action(self, next_state: Tensor) -> Tensor:
        """Add clipped noise to the actions of the target actor, (n, action size)."""
        action = super().target_action(next_state)
        noise = POLICY_NOISE * torch.randn_like(action)
        return (action + noise.clamp_(-NOISE_CLIP, NOISE_CLIP)).clamp_(-1.0, 1.0)
