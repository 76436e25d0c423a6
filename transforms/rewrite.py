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
        achieved_goal_key: the achieved goal, of which that under "next" is read here.
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

    def rewrite(
        self, batch: TensorDictBase, rows: Tensor, goals: Tensor
    ) -> TensorDictBase:
        """Returns a batch in which some rows have other goals, and what follows.

        The batch itself, which may be the storage's own, is left as it is; what is the
        same in both is shared.

        Args:
            batch: transitions, any batch shape.
            rows: which of them, as numbers in the flattened batch, (n,).
            goals: their new goals, (n, *goal).

        Raises:
            ValueError: `reward_fn` or `terminated_fn` returned another shape, or
                something else than a tensor.
        """
        flat = batch if batch.ndim == 1 else batch.reshape(-1)
        achieved = flat.get(self.next_achieved_key).index_select(0, rows)
        old = flat.get(self.goal_key)
        if goals.dtype != old.dtype:
            goals = goals.to(old.dtype)
        next_old = flat.get(self.next_goal_key)
        new = {
            self.goal_key: old.index_copy(0, rows, goals),
            self.next_goal_key: next_old.index_copy(0, rows, goals),
        }
        n = rows.shape[0]
        reward = flat.get(self.reward_key)
        values = _check("reward_fn", self.reward_fn(achieved, goals), n, reward)
        new[self.reward_key] = reward.index_copy(0, rows, values)
        if self.terminated_fn is not None:
            done, terminated = flat.get(_DONE), flat.get(_TERMINATED)
            truncated = flat.get(_TRUNCATED, None)
            if truncated is None:  # what ended without terminating
                truncated = done & ~terminated
            values = self.terminated_fn(achieved, goals)
            values = _check("terminated_fn", values, n, terminated)
            new[_TERMINATED] = terminated.index_copy(0, rows, values)
            values = values | truncated.index_select(0, rows)
            new[_DONE] = done.index_copy(0, rows, values)
        result = batch.exclude(*new)  # a copy also of the tensordicts that hold these
        for key, value in new.items():
            if flat is not batch:
                value = value.reshape(*batch.shape, *value.shape[1:])
            result.set(key, value)
        return result


def _check(function: str, values: Tensor, n: int, old: Tensor) -> Tensor:
    """Returns what a function gave for n rows, in the type of the old values."""
    expected = (n, *old.shape[1:])
    if not isinstance(values, Tensor):
        raise ValueError(
            f"{function} must return a tensor of shape {expected}, got "
            f"{type(values).__name__}."
        )
    if values.shape != expected:
        raise ValueError(
            f"{function} must map (achieved_goal, desired_goal) of {n} transitions to "
            f"shape {expected}, got {tuple(values.shape)}."
        )
    return values if values.dtype == old.dtype else values.to(old.dtype)
