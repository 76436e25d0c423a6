"""Base class of the agents: the gradient step and the policy that all of them share."""

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, TypeVar

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torch_panda.learning.agents.augmentation import augment
from torch_panda.learning.agents.batch import Batch
from torch_panda.learning.agents.hyperparameters import Hyperparameters
from torch_panda.learning.agents.normalizer import Normalizer
from torch_panda.learning.agents.recorded_step import RecordedStep, Step
from torch_panda.learning.environments.geometry import split_goal
from torch_panda.learning.environments.spaces import Spaces
from torch_panda.learning.offline_data import OfflineData
from torch_panda.transforms.strategies import StrategyOption

POLICY_INPUTS: list[NestedKey] = ["observation", "desired_goal"]
LEARNING_RATE = 1e-3  # of actor and critic, from the panda-gym paper
TAU = 0.05  # weight of the online networks when the target networks are updated
# OGBench's mixture of strategies that draw the goals of value functions (arXiv
# 2410.20092, appendix D).
VALUE_GOALS = {"current": 0.2, "geometric": 0.5, "random": 0.3}

_Network = TypeVar("_Network", bound=nn.Module)


class Agent(nn.Module, ABC):
    """A policy with its learning algorithm.

    The constructor of a subclass makes the networks and then calls `assemble`. A
    subclass also defines `losses`. The input of the networks is the "state": the tensor
    that the normaliser computes from observations and goals.

    Attributes:
        spaces: Sizes and layout of observations, goals and actions.
        hp: Hyperparameters.
        normalizer: Computes states from observations and goals.
        state_size: Size of a state.
        gamma: Discount factor.
        alpha: The option of offline agents, or its default for the algorithm.
        min_return: Lower bound of the discounted return; None for dense rewards.
        policy: Module from ``observation`` and ``desired_goal`` to ``action``, which is
            deterministic under ``ExplorationType.DETERMINISTIC``. With `ema_rate`, it
            has the averaged weights.
        explore: The trained policy with the exploration noise of the algorithm.
        optimizer: Optimizer of all trained parameters.
        updates: Number of calls of `update` so far. Calls of `imitate` do not count.

    Raises:
        ValueError: The hyperparameters do not fit the spaces.
    """

    learning_rate: ClassVar[float] = LEARNING_RATE
    tau: ClassVar[float] = TAU
    default_alpha: ClassVar[float] = 0.0
    actor_interval: ClassVar[int] = 1
    """Gradient steps of the critics per gradient step of the actor."""
    value_goal: ClassVar[StrategyOption] = VALUE_GOALS
    """Strategy with which a data set draws the goals of critics and value functions."""
    policy: TensorDictModuleBase
    explore: TensorDictModuleBase
    optimizer: torch.optim.Optimizer

    def __init__(self, spaces: Spaces, hp: Hyperparameters) -> None:
        super().__init__()
        self.spaces, self.hp = spaces, hp
        check_spaces(spaces, hp)
        self.normalizer = Normalizer(spaces, hp.relative_inputs)
        self.state_size = len(self.normalizer.mean)
        self.gamma = hp.gamma or 1 - 1 / spaces.max_episode_steps
        self.alpha = self.default_alpha if hp.alpha is None else hp.alpha
        self.min_return = min_return(self.gamma) if spaces.has_sparse_reward else None
        self.updates = 0
        self._online: list[Tensor] = []
        self._targets: list[Tensor] = []
        self._recorded_steps: dict[tuple[int, ...], RecordedStep] = {}

    @property
    def goal_strategies(self) -> dict[str, StrategyOption]:
        """The strategies with which `OfflineData` draws the goals of each key."""
        return {"value_goal": self.value_goal, "actor_goal": self.hp.actor_goal}

    def extend(self, batch: TensorDictBase, data: OfflineData) -> TensorDictBase:
        """Add further entries of a data set to a sampled batch; by default none."""
        return batch

    def make_target(self, network: _Network) -> _Network:
        """Make a target network: a copy that follows the network slowly."""
        target = copy.deepcopy(network).requires_grad_(False)
        self._online += network.parameters()
        self._targets += target.parameters()
        return target

    def assemble(
        self, actor: TensorDictModuleBase, noise: Sequence[TensorDictModuleBase] = ()
    ) -> None:
        """Make policy, exploration and optimizer, at the end of a constructor.

        Args:
            actor: Module from ``normalized``, which is the state, to ``action``.
            noise: Modules that change ``action`` for exploration.
        """
        trained = [p for p in self.parameters() if p.requires_grad]
        self.optimizer = torch.optim.Adam(trained, lr=self.learning_rate, fused=True)
        normalize = TensorDictModule(self.normalizer, POLICY_INPUTS, ["normalized"])
        to_env_action: list[TensorDictModuleBase] = []
        if self.hp.fine_fingers:
            to_env_action = [TensorDictModule(from_fine, ["action"], ["action"])]
        evaluated = actor
        if self.hp.ema_rate:
            evaluated = copy.deepcopy(actor).requires_grad_(False)
        self._actor_weights: list[Tensor] = [*actor.parameters()]
        self._averaged_weights: list[Tensor] = [*evaluated.parameters()]
        # The overloads of TensorDictSequential lack modules as arguments.
        self.policy = TensorDictSequential(  # type: ignore[call-overload]
            normalize, evaluated, *to_env_action
        )
        self.explore = TensorDictSequential(  # type: ignore[call-overload]
            normalize, actor, *noise, *to_env_action
        )

    @property
    def policy_parts(self) -> dict[str, nn.Module]:
        """The parts of `policy` that have weights, by their names in its file."""
        # The type of a TensorDictSequential's modules is unknown to mypy.
        return {"normalizer": self.normalizer, "actor": self.policy.module[1]}  # type: ignore[index,dict-item]

    def update(
        self, batch: TensorDictBase, demos: TensorDictBase | None = None
    ) -> dict[str, Tensor]:
        """Take one gradient step on a batch of transitions.

        Args:
            batch: Transitions from the replay buffer or the data set, (n,).
            demos: Demonstrated transitions, (m,), which are appended to the batch.

        Returns:
            The losses by name, scalars without gradients.
        """
        batches = [batch] if demos is None else [batch, demos]
        losses = self._get_step(*map(len, batches))(*batches)
        self.updates += 1
        return losses

    @property
    def records_steps(self) -> bool:
        """Whether gradient steps are recorded as CUDA graphs, which is so on a GPU."""
        return self.normalizer.mean.is_cuda

    def _get_step(self, *sizes: int) -> Step:
        """Return the function that takes a gradient step on batches of these sizes."""
        if not self.records_steps:
            return self._step
        # A step with the actor's loss has other kernels than one without.
        key = self.updates % self.actor_interval, *sizes
        if key not in self._recorded_steps:
            self._recorded_steps[key] = RecordedStep(self._step, self.optimizer)
        return self._recorded_steps[key]

    def _step(
        self, batch: TensorDictBase, demos: TensorDictBase | None = None
    ) -> dict[str, Tensor]:
        """Take a gradient step, which may be recorded; see `RecordedStep`."""
        self.optimizer.zero_grad()
        losses = self(batch, demos)
        torch.stack([*losses.values()]).sum().backward()
        self.optimizer.step()
        self._move_average()
        self.move_targets()
        return {key: loss.detach() for key, loss in losses.items()}

    def forward(
        self, batch: TensorDictBase, demos: TensorDictBase | None = None
    ) -> dict[str, Tensor]:
        """The losses on a batch; see `update` and `losses`."""
        return self.losses(self._prepare(Batch.from_tensordict(batch, demos)))

    @abstractmethod
    def losses(self, b: Batch) -> dict[str, Tensor]:
        """The losses of all networks, scalars, which are summed and differentiated.

        A loss detaches or freezes the networks that it must not train, such as the
        critic in the policy's loss.
        """

    @torch.no_grad()
    def move_targets(self) -> None:
        """Move the target networks, if there are any, towards their networks."""
        if self._targets:
            torch._foreach_lerp_(self._targets, self._online, self.tau)

    @torch.no_grad()
    def _move_average(self) -> None:
        """Move the averaged weights, if there are any, towards the actor's weights."""
        rate = self.hp.ema_rate
        if rate:
            torch._foreach_lerp_(self._averaged_weights, self._actor_weights, rate)

    def imitate(self, demos: TensorDictBase) -> Tensor:
        """Take one gradient step of the policy towards demonstrated actions.

        The loss is the mean absolute difference, as in ACT (arXiv 2304.13705). If there
        are two different actions for the same state, this loss leads to the more
        frequent one. A squared loss would lead to an action between the two.

        Args:
            demos: Demonstrated transitions, (n,).

        Returns:
            The loss, a scalar without gradients.
        """
        b = self._prepare(Batch.from_tensordict(demos))
        inputs = dict(zip(POLICY_INPUTS, (b.s, b.g), strict=True))
        # `_prepare` has converted the demonstrated actions to those of the networks. So
        # compare them with the output of the actor, before it is converted for the
        # environment.
        normalize, actor = self.explore.module[:2]  # type: ignore[index]  # a ModuleList
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            td = normalize(demos.empty().update(inputs))
            loss = nn.functional.l1_loss(actor(td)["action"], b.a)
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        self._move_average()
        self.move_targets()
        return loss.detach()

    def _prepare(self, b: Batch) -> Batch:
        """Augment a batch, penalise failures, and convert actions for the networks."""
        b = augment(b, self.spaces.geometry, self.hp.augmentation)
        has_failures = not self.hp.offline  # in data sets, only goals end a return
        if has_failures and self.min_return is not None and self.min_return > -math.inf:
            # A failure that ends an episode gets the return of never reaching the goal.
            # With its reward of -1, an agent would fail on purpose, to avoid the
            # rewards of -1 in the steps that follow.
            rewards = b.r.movedim(-1, 0)  # (n,), or (parts, n)
            rewards = rewards.masked_fill(b.ends & (rewards < 0), self.min_return)
            b = b._replace(r=rewards.movedim(0, -1))
        if self.hp.fine_fingers:
            b = b._replace(a=to_fine(b.a))
        return b

    def set_learning_rate(self, factor: float) -> None:
        """Use factor * `learning_rate` in the next gradient steps.

        On a GPU, the steps that `update` has recorded keep their learning rate.
        """
        for group in self.optimizer.param_groups:
            group["lr"] = factor * self.learning_rate


# How firmly the fingers hold a cube depends on tenths of a millimetre. An action of 1
# moves each finger by 10 cm, so a tenth of a millimetre is an action of 0.001. This is
# less than the error of a network. The cube root of 0.001 is 0.1, which a network can
# learn. So the networks output the cube root of the fingers' action.


def to_fine(action: Tensor) -> Tensor:
    """Replace the finger entry of actions (..., n) by its cube root."""
    rest, fingers = action[..., :-1], action[..., -1:]
    return torch.cat((rest, fingers.sign() * fingers.abs() ** (1 / 3)), -1)


def from_fine(action: Tensor) -> Tensor:
    """Undo `to_fine` for actions (..., n)."""
    return torch.cat((action[..., :-1], action[..., -1:] ** 3), -1)


def min_return(gamma: float) -> float:
    """Lower bound of the discounted return if all rewards are -1 or 0."""
    return -1 / (1 - gamma) if gamma < 1 else -math.inf


def check_spaces(spaces: Spaces, hp: Hyperparameters) -> None:
    """Check that hyperparameters fit an environment.

    Raises:
        ValueError: A hyperparameter needs a gripper, a layout or a control type that
            the environment lacks.
    """
    if hp.fine_fingers and not spaces.has_free_gripper:
        raise ValueError(
            "fine_fingers needs a task whose actions move the fingers, such as "
            "PickAndPlace, Stack or Flip: pass --no-fine-fingers"
        )
    if hp.exploration == "points" and not spaces.follows_points:
        raise ValueError(
            'exploration "points" needs the control type "joints", or three actions '
            "that displace a hand whose position is observed: otherwise pass "
            "--exploration actions"
        )
    if hp.critics == "parts" and len(split_goal(spaces.goal_size)) < 2:
        raise ValueError(
            'critics "parts" needs goals of several objects, such as those of Stack: '
            "pass --critics whole"
        )
    has_mirror = spaces.geometry is not None and spaces.geometry.action is not None
    if hp.augmentation != "none" and not has_mirror:
        raise ValueError(
            f"augmentation {hp.augmentation!r} needs end-effector control, and a task "
            f"that declares observation_layout and goal_entries: otherwise pass "
            f"--augmentation none"
        )
