"""Writing another goal into transitions, and what follows from it."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor

_DONE, _TERMINATED = ("next", "done"), ("next", "terminated")

GoalFunction = Callable[[Tensor, Tensor], Tensor]


@dataclass
class Rewriter:
    """Gives transitions another goal, reward and, if told how, success and end."""

    reward_fn: GoalFunction
    success_fn: GoalFunction | None
    terminated_fn: GoalFunction | None
    goal_key: NestedKey
    achieved_goal_key: NestedKey
    reward_key: NestedKey
    success_key: NestedKey

    def __post_init__(self) -> None:
        """Works out the keys under "next"."""
        self.next_goal_key = unravel_key(("next", self.goal_key))
        self.next_achieved_key = unravel_key(("next", self.achieved_goal_key))
        # Achieved before and by a transition, and desired; the first may be missing.
        self.goal_keys = self.achieved_goal_key, self.next_achieved_key, self.goal_key
        self._needed = [*self.goal_keys[1:], self.next_goal_key, self.reward_key, _DONE]
        self._needed += [self.success_key] if self.success_fn else []
        self._needed += [_TERMINATED] if self.terminated_fn else []

    def check(self, batch: TensorDictBase) -> None:
        """Raises a KeyError that names the entries that are missing in the batch."""
        missing = [key for key in self._needed if batch.get(key, None) is None]
        if missing:
            found = sorted(map(str, batch.keys(True, True)))
            raise KeyError(f"hindsight needs {missing} in the data; found {found}.")

    def rewrite(
        self, batch: TensorDictBase, rows: Tensor, goals: Tensor, *, is_own: bool
    ) -> TensorDictBase:
        """Gives rows, (n,), of the flattened batch other goals, (n, *goal).

        Written to is the batch, if it `is_own`: flat, and made for us; else a copy.
        """
        flat = batch if is_own else batch.reshape(-1).to_tensordict()
        achieved = flat.get(self.next_achieved_key).index_select(0, rows)
        old_goals = flat.get(self.goal_key)
        goals = goals.to(old_goals.dtype)
        reward = evaluate(self.reward_fn, achieved, goals, flat.get(self.reward_key))
        new = {self.goal_key: goals, self.next_goal_key: goals, self.reward_key: reward}
        if self.success_fn is not None:
            success = flat.get(self.success_key)
            new[self.success_key] = evaluate(self.success_fn, achieved, goals, success)
        if self.terminated_fn is not None:
            done, terminated = flat.get(_DONE), flat.get(_TERMINATED)
            # torchrl's trainers call every row truncated: `done` says which were.
            truncated = flat.get(("next", "truncated"), ~terminated) & done
            stays = terminated.index_select(0, rows)
            if stays.any():  # unless the old goal is why it ended: a failure, say
                old = old_goals.index_select(0, rows)
                stays &= ~evaluate(self.terminated_fn, achieved, old, terminated)
            stays |= evaluate(self.terminated_fn, achieved, goals, terminated)
            new[_TERMINATED] = stays
            new[_DONE] = stays | truncated.index_select(0, rows)
        for key, values in new.items():
            flat.get(key).index_copy_(0, rows, values)
        return flat.reshape(batch.shape)


def evaluate(
    function: GoalFunction, achieved: Tensor, desired: Tensor, old: Tensor
) -> Tensor:
    """Returns what a function gives for goals, (n, *goal) each, in the old type."""
    with torch.no_grad():  # it may be learned
        values = function(achieved, desired)
    expected = (len(achieved), *old.shape[1:])
    is_tensor = isinstance(values, Tensor)
    got = tuple(values.shape) if is_tensor else type(values).__name__
    if got != expected:
        raise ValueError(
            "reward_fn, success_fn and terminated_fn map (achieved_goal, desired_goal),"
            f" (n, *goal) each, to a tensor: {function} to {expected}, got {got}."
        )
    return values.to(old.dtype)
