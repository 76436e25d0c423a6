"""Writing another goal into transitions, and what follows from it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor

_DONE = ("next", "done")
_TERMINATED = ("next", "terminated")
_TRUNCATED = ("next", "truncated")

GoalFunction = Callable[[Tensor, Tensor], Tensor]


@dataclass
class Rewriter:
    """Gives transitions another goal, reward and, if told how, another end.

    Attributes:
        reward_fn: maps (achieved_goal, desired_goal), (n, *goal) each, to (n, 1).
        terminated_fn: the same for `terminated`, bool; None leaves the flags alone.
        goal_key: the desired goal, in the root and under "next".
        achieved_goal_key: the achieved goal, read under "next".
        reward_key: the reward, from the root, e.g. ("next", "reward").
    """

    reward_fn: GoalFunction
    terminated_fn: GoalFunction | None
    goal_key: NestedKey
    achieved_goal_key: NestedKey
    reward_key: NestedKey

    def __post_init__(self) -> None:
        """Works out the keys under "next"."""
        self.goal_key = unravel_key(self.goal_key)
        self.reward_key = unravel_key(self.reward_key)
        self.next_goal_key = unravel_key(("next", self.goal_key))
        self.next_achieved_key = unravel_key(("next", self.achieved_goal_key))
        written = (self.goal_key, self.next_goal_key, self.reward_key, _DONE)
        # The tensordicts written into besides the root, outer ones first, each with the
        # name of an entry that is replaced in it.
        self._nested = {
            path[:n]: path[n]
            for path in sorted(key for key in written if isinstance(key, tuple))
            for n in range(1, len(path))
        }

    def check(self, batch: TensorDictBase) -> None:
        """Raises a KeyError that names the entries that are missing in the batch."""
        needed = [
            self.goal_key,
            self.next_goal_key,
            self.next_achieved_key,
            self.reward_key,
            _DONE,
        ]
        if self.terminated_fn is not None:
            needed.append(_TERMINATED)
        missing = [key for key in needed if batch.get(key, None) is None]
        if missing:
            raise KeyError(
                f"hindsight relabelling needs {missing} in the data; found "
                f"{sorted(map(str, batch.keys(True, True)))}."
            )

    def rewrite(self, batch: TensorDictBase, rows: Tensor, goals: Tensor) -> None:
        """Sets the goals of some rows of the batch and recomputes the rest.

        Tensors and nested tensordicts are replaced, not written into: they may be the
        storage's own.

        Args:
            batch: transitions, any batch shape.
            rows: which of them, as numbers in the flattened batch, (n,).
            goals: their new goals, (n, *goal).

        Raises:
            ValueError: `reward_fn` or `terminated_fn` returned another shape.
        """
        flat = batch if batch.ndim == 1 else batch.reshape(-1)
        achieved = flat.get(self.next_achieved_key).index_select(0, rows)
        new = {
            key: flat.get(key).index_copy(0, rows, goals)
            for key in (self.goal_key, self.next_goal_key)
        }
        reward = flat.get(self.reward_key)
        values = self.reward_fn(achieved, goals)
        _check_shape("reward_fn", values, len(rows), reward)
        new[self.reward_key] = reward.index_copy(0, rows, values.to(reward.dtype))
        if self.terminated_fn is not None:
            done, terminated = flat.get(_DONE), flat.get(_TERMINATED)
            truncated = flat.get(_TRUNCATED, None)
            if truncated is None:  # what ended without terminating
                truncated = done & ~terminated
            values = self.terminated_fn(achieved, goals)
            _check_shape("terminated_fn", values, len(rows), terminated)
            new[_TERMINATED] = terminated.index_copy(0, rows, values)
            values = values | truncated.index_select(0, rows)
            new[_DONE] = done.index_copy(0, rows, values)
        parents: dict[tuple[str, ...], TensorDictBase] = {(): batch}
        for path, replaced in self._nested.items():
            parents[path] = batch.get(path).exclude(replaced)  # a shallow copy
        for key, value in new.items():
            path = (key,) if isinstance(key, str) else key
            value = value if flat is batch else value.unflatten(0, batch.shape)
            parents[path[:-1]].set(path[-1], value)
        for path in self._nested:
            parents[path[:-1]].set(path[-1], parents[path])


def _check_shape(function: str, values: Tensor, n: int, old: Tensor) -> None:
    expected = (n, *old.shape[1:])
    if values.shape != expected:
        raise ValueError(
            f"{function} must map (achieved_goal, desired_goal) of {n} transitions to "
            f"shape {expected}, got {tuple(values.shape)}."
        )
