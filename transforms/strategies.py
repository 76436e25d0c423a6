"""Goal strategies: which goal a transition is relabelled with.

A strategy that follows the transition's own trajectory chooses a step of it: `step` is
the transition's own, (n,); stored are the steps from `first` up to and without `end`,
counted from the oldest that is known. The names are those of the paper (Andrychowicz
et al. 2017, section 4.5); "desired", which mixes in the task's own goals, is not in it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import isfinite
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor

from torch_panda.transforms.trajectories import Integers

# A user's own: (step, first, end, generator) -> goal step, int32 tensors on the CPU.
Strategy = Callable[[Tensor, Tensor, Tensor, Generator | None], Tensor]
Weights = dict[str | Strategy, float]

RANDOM = "random"  # what any stored transition achieved
DESIRED = "desired"  # what any stored transition was asked for
# Look ahead only: what follows a stored transition is stored too.
LOOKING_AHEAD = ("future", "final")
NAMES = (*LOOKING_AHEAD, "episode", RANDOM, DESIRED)


def parse_strategies(strategy: str | Strategy | Mapping[Any, float]) -> Weights:
    """Returns strategies and their weights, which add up to 1.

    Raises:
        ValueError: a strategy is neither a name nor a function; a weight is no
            positive number.
    """
    weights = strategy if isinstance(strategy, Mapping) else {strategy: 1.0}
    for name in weights or [strategy]:
        if not callable(name) and name not in NAMES:
            raise ValueError(
                f"strategy must be one of {[*NAMES]}, a callable, or a mapping of "
                f"these to weights, got {name!r}."
            )
    if not all(weight > 0 and isfinite(weight) for weight in weights.values()):
        raise ValueError(
            f"the weights of strategies must be positive numbers, got {strategy!r}."
        )
    total = sum(weights.values())
    return {name: weight / total for name, weight in weights.items()}


def draw_uniform(number: int, generator: Generator | None) -> NDArray[np.float64]:
    """Draws random numbers from 0 to 1, (number,).

    The generator is the CPU's, so that a seed means the same on every device; float32
    would skip steps of trajectories longer than 2**24.
    """
    return torch.rand(
        number, generator=generator, dtype=torch.float64, device="cpu"
    ).numpy()


def draw_integers(
    low: Integers | int, end: Integers, generator: Generator | None
) -> Integers:
    """Draws integers from low up to and without end, (n,)."""
    u = draw_uniform(len(end), generator)
    return low + (u * (end - low)).astype(np.int64)


def draw_strategies(
    weights: Weights, number: int, generator: Generator | None
) -> Integers:
    """Draws strategies by weight; returns their places in `weights`, (number,)."""
    if len(weights) == 1:
        return np.zeros(number, dtype=np.int64)
    limits = np.cumsum([*weights.values()])[:-1]
    return limits.searchsorted(draw_uniform(number, generator), side="right")


def choose_steps(
    strategy: str | Strategy,
    step: Integers,
    first: Integers,
    end: Integers,
    generator: Generator | None,
) -> Integers:
    """Chooses the step whose goal every transition gets, (n,).

    Raises:
        ValueError: a user's own strategy does not return one integer step a
            transition from first up to end.
    """
    if strategy == "final":
        return end - 1
    if isinstance(strategy, str):
        return draw_integers(step if strategy == "future" else first, end, generator)
    tensors = (torch.from_numpy(x.astype(np.int32)) for x in (step, first, end))
    chosen = strategy(*tensors, generator)
    if not isinstance(chosen, Tensor):
        raise ValueError(
            f"the strategy must return a tensor, got {type(chosen).__name__}."
        )
    if chosen.shape != step.shape or chosen.is_floating_point():
        raise ValueError(
            f"the strategy must return integer steps of shape {tuple(step.shape)}, "
            f"got {chosen.dtype} of shape {tuple(chosen.shape)}."
        )
    goal_step: Integers = chosen.cpu().numpy()
    if ((goal_step < first) | (goal_step >= end)).any():
        raise ValueError("the strategy must return steps from first up to end.")
    return goal_step
