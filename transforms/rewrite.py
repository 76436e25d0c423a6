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
    """Gives transitions another goal, reward and, if told how, success and end.

    The functions map (achieved_goal, desired_goal), (n, *goal) each, to (n, 1); without
    one of them what it would give is left alone. The keys are those of the root; both
    goals are also under "next".
    """

    reward_fn: GoalFunction
    success_fn: GoalFunction | None
    terminated_fn: GoalFunction | None
    goal_key: NestedKey
    achieved_goal_key: NestedKey
    reward_key: NestedKey
    success_key: NestedKey

    def __post_init__(self) -> None:
        """Works out the keys under "next"."""
        self.goal_key = unravel_key(self.goal_key)
        self.reward_key = unravel_key(self.reward_key)
        self.success_key = unravel_key(self.success_key)
        self.next_goal_key = unravel_key(("next", self.goal_key))
        self.next_achieved_key = unravel_key(("next", self.achieved_goal_key))
        goals = [self.goal_key, self.next_goal_key, self.next_achieved_key]
        self._needed = [*goals, self.reward_key, _DONE]
        self._needed += [self.success_key] if self.success_fn is not None else []
        self._needed += [_TERMINATED] if self.terminated_fn is not None else []

    def check(self, batch: TensorDictBase) -> None:
        """Raises a KeyError that names the entries that are missing in the batch."""
        missing = [key for key in self._needed if batch.get(key, None) is None]
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
            ValueError: a function does not return a tensor of the right shape.
        """
        flat = batch if batch.ndim == 1 else batch.reshape(-1)
        achieved = flat.get(self.next_achieved_key).index_select(0, rows)
        old_goals = flat.get(self.goal_key)
        goals = goals.to(old_goals.dtype)
        new = {self.goal_key: goals, self.next_goal_key: goals}
        reward = flat.get(self.reward_key)
        new[self.reward_key] = evaluate(
            "reward_fn", self.reward_fn, achieved, goals, reward
        )
        if self.success_fn is not None:
            success = flat.get(self.success_key)
            new[self.success_key] = evaluate(
                "success_fn", self.success_fn, achieved, goals, success
            )
        if self.terminated_fn is not None:
            end = "terminated_fn", self.terminated_fn, achieved
            done, terminated = flat.get(_DONE), flat.get(_TERMINATED)
            truncated = flat.get(_TRUNCATED, None)
            if truncated is None:  # what ended without terminating
                truncated = done & ~terminated
            stays = terminated.index_select(0, rows)
            if stays.any():  # unless the old goal is why it ended: a failure, say
                old = old_goals.index_select(0, rows)
                stays = stays & ~evaluate(*end, old, terminated)
            new[_TERMINATED] = evaluate(*end, goals, terminated) | stays
            new[_DONE] = new[_TERMINATED] | truncated.index_select(0, rows)
        result = batch.exclude(*new)  # a copy also of the tensordicts that hold these
        for key, values in new.items():
            value = flat.get(key).index_copy(0, rows, values)
            if flat is not batch:
                value = value.reshape(*batch.shape, *value.shape[1:])
            result.set(key, value)
        return result


def evaluate(
    name: str, function: GoalFunction, achieved: Tensor, desired: Tensor, old: Tensor
) -> Tensor:
    """Returns what a function gives for goals, (n, *goal) each, in the old type.

    Raises:
        ValueError: it is no tensor of shape (n, *) like the old values, (rows, *).
    """
    values = function(achieved, desired)
    expected = (len(achieved), *old.shape[1:])
    if not isinstance(values, Tensor):
        raise ValueError(
            f"{name} must return a tensor of shape {expected}, got "
            f"{type(values).__name__}."
        )
    if values.shape != expected:
        raise ValueError(
            f"{name} must map (achieved_goal, desired_goal) of {len(achieved)} "
            f"transitions to shape {expected}, got {tuple(values.shape)}."
        )
    return values.to(old.dtype)
