"""Contrastive reinforcement learning (CRL), which needs no rewards.

The critic f(s, a, g) = -|phi(s, a) - psi(g)| learns which goals g an episode achieves
after an action a in a state s (arXiv 2206.07568). Every sampled transition gets a goal
that its episode achieved k steps later, where k is drawn with a probability in
proportion to gamma**k (see `make_buffer` with her="geometric"). At its optimum, f is
log(p(g | s, a) / p(g)) plus a constant. Here p(g | s, a) is the discounted probability
of reaching g after (s, a), and p(g) is the frequency of g in the batches. So f ranks
actions as Q does, and the actor ascends f.

The distance in f and the loss of the critic are those of JaxGCRL (arXiv 2408.11052).
arXiv 2206.07568 and `torch_panda.learning.offline.crl` use an inner product and a
binary loss. With these, Reach had 39 % success after 3,200 steps instead of 100 % (one
seed each).
"""

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from torch_panda.learning.agents.base import Agent
from torch_panda.learning.agents.ddpg import action_penalty
from torch_panda.learning.hyperparameters import Hyperparameters
from torch_panda.learning.networks import make_mlp
from torch_panda.learning.spaces import Spaces
from torch_panda.learning.transitions import Transitions

LATENT_SIZE = 64  # size of phi and psi
LOGSUMEXP_WEIGHT = 0.1  # JaxGCRL's weight of the penalty in the critic's loss


class CRL(Agent):
    """A contrastive critic f(s, a, g), and a deterministic actor that ascends it."""

    def __init__(self, spaces: Spaces, hp: Hyperparameters) -> None:
        super().__init__(spaces, hp)
        action_size = spaces.action_size
        actor = make_mlp(self.state_size, action_size, hp.network)
        self.actor = nn.Sequential(actor, nn.Tanh())
        inputs = len(self.normalizer.state_columns) + action_size
        self.phi = make_mlp(inputs, LATENT_SIZE, hp.network)
        self.psi = make_mlp(spaces.goal_size, LATENT_SIZE, hp.network)
        self.actor_parameters = list(self.actor.parameters())
        self.assemble(
            TensorDictModule(self.actor, ["normalized"], ["action"]),
            self.action_noise(),
            trained=[
                *self.actor_parameters,
                *self.phi.parameters(),
                *self.psi.parameters(),
            ],
        )

    def backward(
        self, state: Tensor, rows: Transitions, num_demos: int
    ) -> dict[str, Tensor]:
        """Compute the losses of critic and actor, and their gradients.

        See `Agent.backward`. Rewards and next states are not used.
        """
        # The augmentation "mirror-shift" shifts half of the rows, each by an offset of
        # its own. The critic can tell a shifted goal from the others by its place. This
        # changes p(g), but for all actions alike, so the best action stays the same.
        s = state[:, self.normalizer.state_columns]
        phi, psi = self.phi(s, rows.action), self.psi(self.normalizer.goal(rows.goal))
        critic_loss = contrastive_loss(-distances(phi, psi))
        critic_loss.backward()

        # Half of the actor's goals belong to other rows, as in the published code of
        # arXiv 2206.07568. The cube rarely moves, so most rows' own goals are achieved
        # before the step.
        other = torch.arange(len(s), device=s.device)
        other[::2] = other[::2].roll(1)
        state = self.normalizer(rows.observation, rows.goal[other])
        before_tanh = self.actor[0](state)
        action = before_tanh.tanh()
        f = -(self.phi(s, action) - psi.detach()[other]).norm(dim=-1)
        penalty = action_penalty(before_tanh, action, self.hp.action_l2)
        actor_loss = penalty - f.mean()
        # Compute gradients for the actor only. The critic keeps the gradients of its
        # own loss.
        actor_loss.backward(inputs=self.actor_parameters)
        return {"critic_loss": critic_loss, "actor_loss": actor_loss}


def distances(x: Tensor, y: Tensor) -> Tensor:
    """Distances of all rows of x and y, (n, size) each: (n, n).

    By default, `torch.cdist` multiplies matrices, which may round small distances to 0.
    """
    return torch.cdist(x, y, compute_mode="donot_use_mm_for_euclid_dist")


def contrastive_loss(logits: Tensor) -> Tensor:
    """Symmetric InfoNCE loss with JaxGCRL's penalty on log-sum-exp, a scalar.

    Args:
        logits: f of every (s, a) with every goal of a batch, (n, n). The goals on the
            diagonal were achieved after (s, a).
    """
    by_row, by_column = logits.logsumexp(1), logits.logsumexp(0)
    loss = by_row + by_column - 2 * logits.diagonal()
    return (loss + LOGSUMEXP_WEIGHT * by_row.square()).mean()
