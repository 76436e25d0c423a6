"""Goal strategies, which choose the step whose goal a relabelled transition gets.

The stored steps of a trajectory are numbered from 0 to `end - 1`. For a transition at
step `step`, most strategies choose one of these steps. Only "random" and "desired" take
goals from other trajectories.

A strategy may also be a user's function `(step, first, end, generator) -> goal step`.
Its steps are int32 tensors (n,) on the CPU. `first` is always 0, the oldest stored
step. `generator` is None for torch's global generator.

"future", "final", "episode" and "random" are the strategies of Andrychowicz et al. 2017
(arXiv 1707.01495), section 4.5. "geometric" draws from the discounted future of a
transition, as contrastive RL does (Eysenbach et al. 2022, arXiv 2206.07568).
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor

Integers = NDArray[np.integer[Any]]
Rows = slice | Integers
# A user's function, see the docstring of this module.
StrategyFunction = Callable[[Tensor, Tensor, Tensor, Generator | None], Tensor]
Strategy = str | StrategyFunction
StrategyOption = Strategy | Mapping[Any, float]  # what users pass as `strategy`

RANDOM, DESIRED = "random", "desired"  # goals of any stored transition
NAMES = ("current", "future", "geometric", "final", "episode", RANDOM, DESIRED)


@dataclass(frozen=True)
class Mixture:
    """A mixture of strategies. Each row's strategy is drawn from it.

    Attributes:
        weights: Probability of each strategy. The probabilities add up to 1.
        discount: Discount of "geometric", which draws the goal achieved k steps later
            with a probability proportional to discount**k, up to the last stored step.
    """

    weights: Mapping[Strategy, float]
    discount: float

    @classmethod
    def parse(cls, strategy: StrategyOption, discount: float) -> "Mixture":
        """Makes a mixture from one strategy, or from strategies mapped to weights.

        Raises:
            ValueError: A strategy is unknown, a weight is not positive and finite, or
                the discount is not within [0, 1].
        """
        if not 0 <= discount <= 1:
            raise ValueError(f"discount must be within [0, 1], got {discount}")
        names = [*strategy] if isinstance(strategy, Mapping) else [strategy]
        for name in names or [strategy]:
            if not callable(name) and name not in NAMES:
                raise ValueError(
                    f"strategy must be one of {[*NAMES]}, a callable, or a mapping of "
                    f"these to weights, got {name!r}"
                )
        weights = strategy if isinstance(strategy, Mapping) else {strategy: 1.0}
        if not all(weight > 0 and np.isfinite(weight) for weight in weights.values()):
            raise ValueError(
                f"strategy must have positive, finite weights, got {strategy!r}"
            )
        total = sum(weights.values())
        shares = {name: weight / total for name, weight in weights.items()}
        return cls(shares, discount)

    def split(
        self, n: int, generator: Generator | None
    ) -> Iterator[tuple[Strategy, Rows]]:
        """Draws a strategy for each of n rows. Yields each strategy with its rows."""
        if len(self.weights) == 1:
            yield next(iter(self.weights)), slice(None)
            return
        upper_limits = np.cumsum([*self.weights.values()])[:-1]
        u = draw_uniform(n, generator)
        choices = upper_limits.searchsorted(u, side="right")
        for number, strategy in enumerate(self.weights):
            yield strategy, (choices == number).nonzero()[0]


def draw_uniform(n: int, generator: Generator | None) -> NDArray[np.float64]:
    """Draws n numbers from [0, 1) on the CPU. None means torch's global generator."""
    u = torch.rand(n, generator=generator, dtype=torch.float64, device="cpu")
    return u.numpy()


def draw_integers(
    low: Integers | int, end: Integers, generator: Generator | None
) -> Integers:
    """Draws integers from `low` to `end - 1`, (n,)."""
    u = draw_uniform(len(end), generator)
    return low + (u * (end - low)).astype(np.int64)


def draw_geometric(
    end: Integers, discount: float, generator: Generator | None
) -> Integers:
    """Draws k < `end` with probability proportional to discount**k, (n,)."""
    if discount == 1:
        return draw_integers(0, end, generator)
    u = draw_uniform(len(end), generator)
    if discount == 0:
        return np.zeros(len(end), dtype=np.int64)
    # Inverse transform sampling: P(k < x) = (1 - discount**x) / (1 - discount**end).
    x = np.log1p(-u * (1 - discount**end)) / np.log(discount)
    return np.minimum(x.astype(np.int64), end - 1)


def choose_steps(
    strategy: Strategy,
    step: Integers,
    end: Integers,
    discount: float,
    generator: Generator | None,
) -> Integers:
    """Chooses a step of the same trajectory for each transition.

    Args:
        strategy: Name of a strategy other than "random" and "desired", or a user's
            function.
        step: Steps of the transitions, counted from the oldest stored step of their
            trajectories, (n,).
        end: Number of stored steps of each trajectory, (n,).
        discount: Discount per step of "geometric".
        generator: Generator of the random draws; None means torch's global generator.

    Raises:
        ValueError: A user's function did not return integers from 0 to `end - 1`.
    """
    if strategy == "current":
        return step
    if strategy == "geometric":
        return step + draw_geometric(end - step, discount, generator)
    if strategy == "final":
        return end - 1
    if strategy == "future":
        return draw_integers(step, end, generator)
    if strategy == "episode":
        return draw_integers(0, end, generator)
    assert callable(strategy)
    return _call(strategy, step, end, generator)


def _call(
    function: StrategyFunction,
    step: Integers,
    end: Integers,
    generator: Generator | None,
) -> Integers:
    """Calls a user's strategy."""
    first = np.zeros_like(step)
    steps, firsts, ends = (
        torch.from_numpy(numbers.astype(np.int32)) for numbers in (step, first, end)
    )
    chosen = function(steps, firsts, ends, generator)
    is_integer = isinstance(chosen, Tensor) and not chosen.is_floating_point()
    if is_integer and chosen.shape == steps.shape:
        goal_steps: Integers = chosen.numpy(force=True)
        if ((goal_steps >= 0) & (goal_steps < end)).all():
            return goal_steps
    raise ValueError(
        f"the strategy must return a tensor of integer steps {tuple(steps.shape)}, "
        f"from first to end - 1, got {chosen!r}"
    )
