"""Training episodes that start in rare states which the agent itself has reached.

Hindsight goals teach nothing about an object until something moves it, and nothing
about heights until something lifts it. In tasks such as Stack, this rarely happens by
chance. But what has happened once can be the start of many episodes, from which the
agent goes on to states that are even rarer. Reverse curriculum generation (arXiv
1707.05300) and Go-Explore (arXiv 1901.10995) also start episodes in reached states. The
preference for rare achieved goals comes from MEGA (arXiv 2007.02832).
"""

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Transform

from torch_panda.envs.state import BODY_KEYS
from torch_panda.learning.environments.geometry import split_goal

CAPACITY = 6_000  # number of the latest states that are kept
FEWEST = 500  # episodes start there once this many states are kept
# Fraction of the steps at which the states of all environments are kept, besides those
# at a reset of all environments.
KEPT = 0.2
# A state is rare if few of COMPARED states, drawn from all, have achieved goals within
# NEAR [m] (without unit for goals that are no positions). A state with n such
# neighbours is drawn with a probability in proportion to (1 + n) ** -RARITY.
COMPARED, NEAR, RARITY = 2_000, 0.03, 2.5
# Objects that fall, and objects far from the task's own starts and goals, do not help.
MAX_SPEED = 0.5  # of an object in a state that is drawn [m/s]
MARGIN = 0.05  # distance to the range of the task's own starts and goals [m]


class StartReached(Transform):
    """Starts some episodes in rare reached states, with goals drawn by the task.

    Args:
        ratio: Fraction of the episodes that start in these states. torch's global
            generator chooses the episodes and the states.

    Attributes:
        states: The latest states (n,), as `RobotTaskEnv.get_state` returns them, with
            ``achieved_goal``. A run that is resumed needs them.
    """

    def __init__(self, ratio: float) -> None:
        super().__init__()
        self.ratio = ratio
        storage = LazyTensorStorage(CAPACITY, device="cpu")
        self.states = TensorDictReplayBuffer(storage=storage)
        # States and their weights, computed once after each reset of all environments.
        # Weights for each reset would double the time of trainings on short episodes.
        self._weighted: tuple[TensorDict, Tensor] | None = None

    def _step(
        self, tensordict: TensorDictBase, next_tensordict: TensorDictBase
    ) -> TensorDictBase:
        if torch.rand(()) < KEPT:
            self._keep(next_tensordict)
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        assert self.parent is not None
        env = self.parent.base_env
        requested = tensordict.get("_reset", None)
        if requested is None or requested.all():
            self._keep(tensordict_reset)
            self._weighted = None
        if len(self.states) < FEWEST:
            return tensordict_reset
        is_chosen = torch.rand(*env.batch_size, 1) < self.ratio
        if requested is not None:
            is_chosen &= requested.cpu()
        if not is_chosen.any():
            return tensordict_reset
        if self._weighted is None:
            states: TensorDict = self.states[:]
            keys = [key for key in BODY_KEYS if key in states.keys()]  # noqa: SIM118
            self._weighted = states.select(*keys).clone(), weigh(states)
        states, weights = self._weighted
        if not weights.any():
            return tensordict_reset
        chosen = torch.multinomial(weights, env.batch_size.numel(), replacement=True)
        start = tensordict_reset.copy().update(states[chosen].to(env.device))
        # Reset the chosen environments again, to these states. The others keep the
        # observations of the first reset.
        start = env.reset(start.set("_reset", is_chosen.to(env.device)), set_state=True)
        return start.select(*tensordict_reset.keys(True, True))

    def _keep(self, observed: TensorDictBase) -> None:
        """Keep the present states of all environments."""
        assert self.parent is not None
        state: TensorDict = self.parent.base_env.get_state()  # type: ignore[operator]
        state = state.set("achieved_goal", observed["achieved_goal"])
        self.states.extend(state.cpu())


def weigh(states: TensorDictBase) -> Tensor:
    """Unnormalised probability that an episode starts in each state, (n,).

    Args:
        states: States (n,), see `StartReached`.
    """
    achieved, desired = states["achieved_goal"], states["desired_goal"].float()
    parts = split_goal(achieved.shape[-1])
    others = torch.randint(len(states), (COMPARED,))
    # A state is rare if a part of its achieved goal is.
    neighbours = [
        (torch.cdist(achieved[:, part], achieved[others, part]) < NEAR).sum(1)
        for part in parts
    ]
    weights = (1.0 + torch.stack(neighbours).amin(0)).pow(-RARITY)
    # The range of the task's own starts and goals, for all objects together. Only the
    # task's own starts are kept with no step.
    is_start = states["step_count"].squeeze(1) == 0
    known = torch.cat((desired, achieved[is_start])).unflatten(-1, (len(parts), -1))
    lowest, highest = known.flatten(0, 1).aminmax(dim=0)
    reached = achieved.unflatten(-1, (len(parts), -1))
    is_far = (reached < lowest - MARGIN) | (reached > highest + MARGIN)
    fails = is_far.flatten(1).any(1)
    if "object_velocity" in states.keys():  # noqa: SIM118 (a TensorDict)
        speed = states["object_velocity"][..., :3].norm(dim=-1)
        fails |= (speed > MAX_SPEED).any(-1)
    return weights.masked_fill(fails, 0.0)
