"""Base class of the agents that learn offline, and the losses that several share.

`update` takes one gradient step on a batch of `OfflineData`, and `policy` acts. Agents
differ in their `losses`, and in the `goal_strategies` with which
`torch_panda.transforms.GoalSampler` draws their goals. The docstrings of the losses
cite the papers.

In the papers a goal is a state g. Here a goal is the part of a state that the task
cares about, such as the position of a cube, because the policy gets ``desired_goal``.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.modules import MLP

from torch_panda.learning.hyperparameters import RelativeInputs
from torch_panda.learning.limits import Discount, Positive, Weight
from torch_panda.learning.normalizer import Normalizer
from torch_panda.learning.offline.data import OfflineData
from torch_panda.learning.spaces import Spaces
from torch_panda.transforms.strategies import StrategyOption

MAX_WEIGHT = 100.0  # largest weight of a row in advantage-weighted regression
# OGBench's mixture of strategies that draw the goals of value functions (arXiv
# 2410.20092, appendix D).
VALUE_GOALS = {"current": 0.2, "geometric": 0.5, "random": 0.3}
# OGBench has 512 units and batches of 1,024. Here both are smaller, so that a gradient
# step takes an eighth of the time, which suits a CPU.
HIDDEN_SIZE = 256  # units of each of the three hidden layers
# OGBench's learning rate of Adam, and the weight of the trained networks when target
# networks are updated (not the tau of expectiles).
LEARNING_RATE = 3e-4
TAU = 0.005


@dataclass
class OfflineHyperparameters:
    """Hyperparameters of the offline agents, which are also options of the command."""

    algo: str = "gcivl"
    """algorithm: "gcbc", "gcivl", "gciql", "hiql", "qrl" or "crl\""""
    discount: Discount = 0.99
    """discount factor of the values, also used by the goal strategy "geometric" """
    batch_size: Positive = 256
    """transitions per gradient step"""
    alpha: Weight | None = None
    """weight of the imitation in the policy's loss (GCIQL, CRL), or inverse temperature
    of the weights of imitated actions (GCIVL, HIQL, QRL). None means the default of the
    algorithm. GCBC has none"""
    actor_goal: Literal["future", "geometric"] = "future"
    """how to draw the goals of the policy among those achieved later in the episode.
    "future", as in OGBench: all are equally likely. "geometric": the goal achieved k
    steps later has probability proportional to discount**k"""
    relative_inputs: RelativeInputs = "fine"
    """additional inputs of the networks. "coarse" adds the offsets from the hand to
    objects and from objects to goals. "fine" also adds these offsets clipped at 3 cm,
    so that differences of millimetres count. A task without `observation_layout` has no
    offsets, and the training warns of this"""


class Batch(NamedTuple):
    """Sampled transitions (s, a, s') with goals, named as in the papers.

    Attributes:
        s: Observations before the step, (n, observation size).
        a: Actions, (n, action size).
        s_next: Observations after the step, (n, observation size).
        achieved: Goals achieved by ``s_next``, (n, goal size).
        r: Rewards: 0 if ``s_next`` reaches the goal ``g``, and -1 if not, (n,).
        mask: 0 if ``s_next`` reaches the goal ``g``, so that the return ends, and 1 if
            not, (n,).
        g: Goals for the losses of the value functions, (n, goal size).
        g_actor: Goals for the losses of the policies, (n, goal size).
    """

    s: Tensor
    a: Tensor
    s_next: Tensor
    achieved: Tensor
    r: Tensor
    mask: Tensor
    g: Tensor
    g_actor: Tensor

    @classmethod
    def from_tensordict(cls, batch: TensorDictBase) -> "Batch":
        """Read the transitions that `OfflineData` sampled."""
        after = batch.get("next")
        # `OfflineData` terminates where the value goal is reached.
        reached = after.get("terminated").squeeze(-1)
        return cls(
            s=batch.get("observation"),
            a=batch.get("action"),
            s_next=after.get("observation"),
            achieved=after.get("achieved_goal"),
            r=after.get("reward").squeeze(-1),
            mask=1.0 - reached.float(),
            g=batch.get("value_goal"),
            g_actor=batch.get("actor_goal"),
        )


class OfflineAgent(nn.Module, ABC):
    """A policy that learns from a data set.

    Args:
        spaces: Sizes and layout of observations, goals and actions.
        hp: Hyperparameters.

    Attributes:
        spaces: Sizes and layout of observations, goals and actions.
        hp: Hyperparameters.
        normalizer: Standardises observations and goals, and appends the offsets of
            `relative_inputs`.
        policy: Module from ``observation`` and ``desired_goal`` to ``action`` in
            [-1, 1], deterministic.
        optimizer: Optimizer of all networks that learn.
        updates: Number of gradient steps so far.
        alpha: The option, or its default for the algorithm.
        value_goal: Strategy that draws the goals of the value functions.
    """

    default_alpha: ClassVar[float] = 0.0
    value_goal: ClassVar[StrategyOption] = VALUE_GOALS
    policy: TensorDictModuleBase
    optimizer: torch.optim.Optimizer

    def __init__(self, spaces: Spaces, hp: OfflineHyperparameters) -> None:
        super().__init__()
        self.spaces, self.hp = spaces, hp
        # Offsets need a `Geometry`, which some tasks do not have.
        relative_inputs = hp.relative_inputs if spaces.geometry else "none"
        self.normalizer = Normalizer(spaces, relative_inputs)
        self.alpha = self.default_alpha if hp.alpha is None else hp.alpha
        self.updates = 0

    @property
    def goal_strategies(self) -> dict[str, StrategyOption]:
        """The strategy with which `GoalSampler` draws the goals of each key."""
        return {"value_goal": self.value_goal, "actor_goal": self.hp.actor_goal}

    def assemble(self, actor: nn.Module) -> None:
        """Assemble policy and optimizer at the end of a constructor.

        Args:
            actor: Module from observation and goal to the mean action.
        """
        module = DeterministicPolicy(actor)
        self.policy = TensorDictModule(
            module, ["observation", "desired_goal"], ["action"]
        )
        trained = [p for p in self.parameters() if p.requires_grad]
        self.optimizer = torch.optim.Adam(trained, lr=LEARNING_RATE, fused=True)

    def extend(self, batch: TensorDictBase, data: OfflineData) -> TensorDictBase:
        """Add further entries of the data to a sampled batch; by default none."""
        return batch

    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Take one gradient step on a batch with goals by `goal_strategies`.

        Returns:
            The losses, scalars without gradients.
        """
        self.optimizer.zero_grad()
        losses = self.losses(batch)
        torch.stack(list(losses.values())).sum().backward()
        self.optimizer.step()
        self.updates += 1
        self.move_targets()
        return {key: loss.detach() for key, loss in losses.items()}

    @abstractmethod
    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """The losses of all networks, scalars, which are summed and differentiated.

        A loss detaches or freezes the networks that it must not train, such as the
        critic in the policy's loss.
        """

    def move_targets(self) -> None:
        """Move the target networks, if there are any, towards their networks."""


class DeterministicPolicy(nn.Module):
    """The mean action of an actor, clipped to [-1, 1].

    Args:
        actor: Module from observation and goal, (..., size) each, to (..., action
            size).
    """

    def __init__(self, actor: nn.Module) -> None:
        super().__init__()
        self.actor = actor

    def forward(self, observation: Tensor, goal: Tensor) -> Tensor:
        """The action, (..., action size)."""
        return self.actor(observation, goal).clamp(-1.0, 1.0)


class Actor(nn.Module):
    """The mean of a Gaussian policy pi(a | s, g) with unit variance.

    Args:
        normalizer: Standardises observations and goals.
        action_size: Size of an action.
    """

    def __init__(self, normalizer: Normalizer, action_size: int) -> None:
        super().__init__()
        self.normalizer = normalizer
        self.net = make_gelu_mlp(len(normalizer.mean), action_size)

    def forward(self, s: Tensor, g: Tensor) -> Tensor:
        """The mean action, (..., action size)."""
        return self.net(self.normalizer(s, g))


class Ensemble(nn.ModuleList):
    """Two value functions V(x) or Q(x) of the same inputs.

    Args:
        inputs: Total size of the inputs, which are concatenated.
    """

    def __init__(self, inputs: int) -> None:
        super().__init__(make_gelu_mlp(inputs, 1) for _ in range(2))

    def forward(self, *inputs: Tensor) -> Tensor:
        """The two values, (2, n)."""
        return torch.stack([net(*inputs).squeeze(-1) for net in self])


def make_gelu_mlp(inputs: int, outputs: int) -> MLP:
    """Make a network with three hidden layers that concatenates its inputs."""
    return MLP(
        in_features=inputs,
        out_features=outputs,
        num_cells=[HIDDEN_SIZE] * 3,
        activation_class=nn.GELU,
        norm_class=nn.LayerNorm,
        norm_kwargs=[{"normalized_shape": HIDDEN_SIZE}] * 3,
    )


def log_prob(mean: Tensor, x: Tensor) -> Tensor:
    """Log density of a Gaussian with unit variance, without its constant, (n,)."""
    return -0.5 * (x - mean).square().sum(-1)


def expectile_loss(diff: Tensor, advantage: Tensor, expectile: float) -> Tensor:
    """Squared differences, weighted by the sign of the advantage (2110.06169, eq. 5).

    In the paper the advantage is the difference itself.

    Args:
        diff: Target minus prediction, (..., n).
        advantage: Advantage of each row, (n,).
        expectile: Weight of rows whose advantage is at least 0, tau in the paper.
            Others have the weight 1 - tau.

    Returns:
        The weighted squares, (..., n).
    """
    weight = torch.where(advantage < 0, 1 - expectile, expectile)
    return weight * diff.square()


def ensemble_loss(q: Tensor, v: Tensor, v_target: Tensor, expectile: float) -> Tensor:
    """Expectile regression of the two values of an `Ensemble`, a scalar.

    HIQL's paper (2307.11949, eq. 4) has one value function. Here there are two, as in
    OGBench, and each regresses to its own target. Both squared errors have the same
    weight, which depends on the advantage: the smaller target minus the mean of the two
    ``v_target``.

    Args:
        q: Targets r + discount * mask * V(s', g) of the target networks, (2, n).
        v: Values V(s, g), (2, n).
        v_target: Values V(s, g) of the target networks, (2, n).
        expectile: See `expectile_loss`.
    """
    advantage = q.amin(0) - v_target.mean(0)
    return expectile_loss(q - v, advantage, expectile).sum(0).mean()


def weighted_regression(log_probs: Tensor, advantage: Tensor, alpha: float) -> Tensor:
    """Advantage-weighted regression, a scalar (2110.06169, eq. 7).

    The paper writes beta for ``alpha``.

    Args:
        log_probs: Log probabilities of the imitated actions or waypoints, (n,).
        advantage: Their advantages, (n,).
        alpha: Inverse temperature. 0 imitates all rows alike.
    """
    weight = (alpha * advantage.detach()).exp().clamp(max=MAX_WEIGHT)
    return -(weight * log_probs).mean()


def ascend_and_imitate(q: Tensor, log_probs: Tensor, alpha: float) -> Tensor:
    """DDPG+BC, as in OGBench: ascend Q, and imitate the data with weight alpha.

    TD3+BC (2106.06860) has the same two terms, but its alpha is the weight of Q.

    Args:
        q: Values of the policy's actions, (n,). They are divided by their mean
            magnitude, so that alpha does not depend on the scale of rewards.
        log_probs: Log probabilities of the actions of the data, (n,).
        alpha: Weight of the imitation.
    """
    scale = q.detach().abs().mean() + 1e-6
    return -q.mean() / scale - alpha * log_probs.mean()


@torch.no_grad()
def move_towards(target: nn.Module, online: nn.Module) -> None:
    """Move the parameters of a target network towards those of its network."""
    targets: list[Tensor] = [*target.parameters()]
    sources: list[Tensor] = [*online.parameters()]
    torch._foreach_lerp_(targets, sources, TAU)
