"""Goal strategies: at which step of its trajectory a goal was achieved.

`step` is the transition's own step, (n,); what is stored of its trajectory are the
steps from `first` up to and without `end`, and the goal's step is one of them. The
names are those of the paper (Andrychowicz et al. 2017, section 4.5).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor

from torch_panda.transforms.trajectories import Integers

# A user's own: (step, first, end, generator) -> goal step, int32 tensors on the CPU.
Strategy = Callable[[Tensor, Tensor, Tensor, Generator | None], Tensor]

# (step, first, end, share) -> goal step, with random numbers from 0 to 1, float64:
# float32 would skip steps of trajectories longer than 2**24.
Shares = NDArray[np.float64]
_BuiltIn = Callable[[Integers, Integers, Integers, Shares], Integers]

# Looks ahead only: what follows a stored transition is stored too.
LOOKING_AHEAD = ("future", "final")
RANDOM = "random"  # any stored transition of any trajectory: no step of its own


def uniform(low: Integers | int, end: Integers | int, share: Shares) -> Integers:
    """Maps random numbers to integers from low up to and without end, (n,)."""
    return low + (share * (end - low)).astype(np.int64)


def future(step: Integers, first: Integers, end: Integers, share: Shares) -> Integers:
    """Draws this step or a later one."""
    return uniform(step, end, share)


def final(step: Integers, first: Integers, end: Integers, share: Shares) -> Integers:
    """Takes the last step."""
    return end - 1


def episode(step: Integers, first: Integers, end: Integers, share: Shares) -> Integers:
    """Draws any step of the trajectory."""
    return uniform(first, end, share)


STRATEGIES: dict[str, _BuiltIn] = {
    "future": future,
    "final": final,
    "episode": episode,
}


def check_strategy(strategy: str | Strategy) -> None:
    """Raises a ValueError if it is neither a strategy's name nor a function."""
    if not callable(strategy) and strategy not in (*STRATEGIES, RANDOM):
        raise ValueError(
            f"strategy must be one of {[*STRATEGIES, RANDOM]} or a callable, "
            f"got {strategy!r}."
        )


def choose_steps(
    strategy: str | Strategy,
    step: Integers,
    first: Integers,
    end: Integers,
    share: Shares,
    generator: Generator | None,
) -> Integers:
    """Calls the strategy and checks what a user's own returns.

    Raises:
        ValueError: it is not one integer step a transition from first up to end.
    """
    if isinstance(strategy, str):
        return STRATEGIES[strategy](step, first, end, share)
    steps, firsts, ends = (
        torch.from_numpy(x.astype(np.int32)) for x in (step, first, end)
    )
    goal_step = strategy(steps, firsts, ends, generator)
    if not isinstance(goal_step, Tensor):
        raise ValueError(
            f"the strategy must return a tensor, got {type(goal_step).__name__}."
        )
    if goal_step.shape != step.shape or goal_step.is_floating_point():
        raise ValueError(
            f"the strategy must return integer steps of shape {tuple(step.shape)}, "
            f"got {goal_step.dtype} of shape {tuple(goal_step.shape)}."
        )
    chosen = goal_step.cpu().numpy()
    if ((chosen < first) | (chosen >= end)).any():
        raise ValueError("the strategy must return steps from first up to end.")
    return chosen
