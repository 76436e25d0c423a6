"""Goal strategies: which goal a transition is relabelled with.

One that follows the transition's trajectory chooses a step of it: `step`, (n,), is its
own; stored are those from `first` up to and without `end`, counted from the oldest
known. All but "desired" are those of Andrychowicz et al. 2017, section 4.5.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor

Integers = NDArray[np.integer[Any]]
# A user's own: (step, first, end, generator) -> goal step, int32 tensors on the CPU.
Strategy = Callable[[Tensor, Tensor, Tensor, Generator | None], Tensor]
Weights = dict[str | Strategy, float]
Weighted = str | Strategy | Mapping[Any, float]  # as users give them

RANDOM, DESIRED = "random", "desired"  # of any stored transition
LOOKING_AHEAD = ("future", "final")  # what follows a stored transition is stored too
NAMES = (*LOOKING_AHEAD, "episode", RANDOM, DESIRED)


def parse(strategy: Weighted) -> Weights:
    """Returns strategies and weights that add up to 1; a ValueError if it cannot."""
    weights = strategy if isinstance(strategy, Mapping) else {strategy: 1.0}
    for name in weights or [strategy]:
        if not callable(name) and name not in NAMES:
            known = f"one of {[*NAMES]}, a callable, or a mapping of these to weights"
            raise ValueError(f"strategy must be {known}, got {name!r}.")
    if not all(weight > 0 and np.isfinite(weight) for weight in weights.values()):
        raise ValueError(f"strategy must have positive weights, got {strategy!r}.")
    total = sum(weights.values())
    return {name: weight / total for name, weight in weights.items()}


def draw_uniform(number: int, generator: Generator | None) -> NDArray[np.float64]:
    """Draws random numbers from 0 to 1, (number,), with a generator of the CPU's."""
    u = torch.rand(number, generator=generator, dtype=torch.float64, device="cpu")
    return u.numpy()


def draw_integers(
    low: Integers | int, end: Integers, generator: Generator | None
) -> Integers:
    """Draws integers from low up to and without end, (n,)."""
    u = draw_uniform(len(end), generator)
    return low + (u * (end - low)).astype(np.int64)


def choose_steps(
    strategy: str | Strategy,
    step: Integers,
    first: Integers,
    end: Integers,
    generator: Generator | None,
) -> Integers:
    """Chooses steps, (n,), for transitions of steps `step` from `first` up to `end`."""
    if strategy == "final":
        return end - 1
    if isinstance(strategy, str):
        return draw_integers(step if strategy == "future" else first, end, generator)
    numbers = (step - first, 0 * step, end - first)
    s, f, e = (torch.from_numpy(x.astype(np.int32)) for x in numbers)
    chosen = strategy(s, f, e, generator)
    is_right = isinstance(chosen, Tensor) and chosen.shape == s.shape
    if is_right and not chosen.is_floating_point():
        steps: Integers = chosen.numpy(force=True)
        if ((steps >= 0) & (steps < end - first)).all():
            return first + steps
    raise ValueError(
        f"the strategy must return a tensor of integer steps {tuple(s.shape)}, from "
        f"first up to end, got {chosen!r}."
    )
