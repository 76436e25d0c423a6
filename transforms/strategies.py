"""Goal strategies: at which step of its trajectory a goal was achieved.

A strategy is a function `(step, first, end, generator) -> goal step` of int32 tensors
of shape (n,). `step` is the transition's own step; what is stored of its trajectory are
the steps from `first` up to and without `end`, and the goal's step is one of them.
The names are those of the paper (Andrychowicz et al. 2017, section 4.5).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Generator, Tensor

Strategy = Callable[[Tensor, Tensor, Tensor, Generator | None], Tensor]

RANDOM = "random"  # any stored transition of any trajectory: no step of its own


def uniform(low: Tensor, end: Tensor, generator: Generator | None) -> Tensor:
    """Draws an integer for every pair, uniform from low up to and without end, (n,)."""
    # float64, as float32 would skip steps of trajectories longer than 2**24; the
    # generator is the CPU's, so that a seed means the same on every device.
    share = torch.rand(low.shape, generator=generator, dtype=torch.float64)
    return share.to(low.device).mul_(end - low).int().add_(low)


def future(
    step: Tensor, first: Tensor, end: Tensor, generator: Generator | None
) -> Tensor:
    """Draws this step or a later one."""
    return uniform(step, end, generator)


def final(
    step: Tensor, first: Tensor, end: Tensor, generator: Generator | None
) -> Tensor:
    """Takes the last step."""
    return end - 1


def episode(
    step: Tensor, first: Tensor, end: Tensor, generator: Generator | None
) -> Tensor:
    """Draws any step of the trajectory."""
    return uniform(first, end, generator)


STRATEGIES: dict[str, Strategy] = {
    "future": future,
    "final": final,
    "episode": episode,
}


def make_strategy(strategy: str | Strategy) -> Strategy | None:
    """Returns the strategy of that name, None for "random", a callable as it is.

    Raises:
        ValueError: the name is unknown.
    """
    if not isinstance(strategy, str):
        return strategy
    if strategy == RANDOM:
        return None
    if strategy not in STRATEGIES:
        raise ValueError(
            f"strategy must be one of {[*STRATEGIES, RANDOM]} or a callable, "
            f"got {strategy!r}."
        )
    return STRATEGIES[strategy]


def choose_steps(
    strategy: Strategy,
    step: Tensor,
    first: Tensor,
    end: Tensor,
    generator: Generator | None,
) -> Tensor:
    """Calls the strategy and checks what a user's own returns.

    Raises:
        ValueError: it is not one integer step a transition from first up to end.
    """
    goal_step = strategy(step, first, end, generator)
    if strategy in STRATEGIES.values():
        return goal_step
    if goal_step.shape != step.shape or goal_step.is_floating_point():
        raise ValueError(
            f"the strategy must return integer steps of shape {tuple(step.shape)}, "
            f"got {goal_step.dtype} of shape {tuple(goal_step.shape)}."
        )
    if ((goal_step < first) | (goal_step >= end)).any():
        raise ValueError("the strategy must return steps from first up to end.")
    return goal_step
