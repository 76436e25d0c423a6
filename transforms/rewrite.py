"""Writes other goals into transitions, and recomputes all that depends on the goal."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor

DONE, TERMINATED, TRUNCATED = (
    ("next", name) for name in ("done", "terminated", "truncated")
)

# Maps (achieved_goal, desired_goal), (n, *goal) each, to values (n, 1).
GoalFunction = Callable[[Tensor, Tensor], Tensor]


@dataclass
class Rewriter:
    """Gives transitions other goals, and recomputes the entries that depend on them.

    These entries are the reward, the success, and the "ends": ("next", "terminated")
    and ("next", "done").

    Attributes:
        reward_fn: Reward of a transition.
        success_fn: Success of a transition. If None, success stays as stored.
        terminated_fn: Whether a transition terminates its episode because its goal is
            reached. If None, the ends stay as stored.
        goal_key: Key of the desired goal, at the root and under "next".
        achieved_goal_key: Key of the achieved goal, at the root and under "next".
        reward_key: Key of the reward.
        success_key: Key of the success.
    """

    reward_fn: GoalFunction
    success_fn: GoalFunction | None
    terminated_fn: GoalFunction | None
    goal_key: NestedKey
    achieved_goal_key: NestedKey
    reward_key: NestedKey
    success_key: NestedKey

    def __post_init__(self) -> None:
        """Adds the keys of the goals under "next"."""
        self.next_goal_key = unravel_key(("next", self.goal_key))
        self.next_achieved_key = unravel_key(("next", self.achieved_goal_key))

    def check_entries(self, batch: TensorDictBase) -> None:
        """Checks that the batch has all entries that this class reads or rewrites.

        Raises:
            KeyError: Entries are missing.
        """
        needed = [self.next_achieved_key, self.goal_key, self.next_goal_key]
        needed += [self.reward_key, DONE]
        needed += [self.success_key] if self.success_fn else []
        needed += [TERMINATED] if self.terminated_fn else []
        missing = [key for key in needed if batch.get(key, None) is None]
        if missing:
            entries = sorted(map(str, batch.keys(True, True)))
            hint = ""
            if self.success_key in missing:
                hint = "; if the data hold no success, pass success_fn=None"
            raise KeyError(
                f"hindsight needs {missing} in the data, which has {entries}{hint}"
            )

    def rewrite(self, batch: TensorDictBase, rows: Tensor, goals: Tensor) -> None:
        """Gives some rows of a batch other goals, in place.

        Args:
            batch: Transitions, (m,).
            rows: Indices into the batch, (n,).
            goals: New goals of these rows, (n, *goal).
        """
        goals = goals.to(batch.get(self.goal_key).dtype)
        values = self.evaluate(batch, rows, goals)
        values |= {self.goal_key: goals, self.next_goal_key: goals}
        for key, new in values.items():
            batch.get(key).index_copy_(0, rows, new)

    def evaluate(
        self, batch: TensorDictBase, rows: Tensor, goals: Tensor
    ) -> dict[NestedKey, Tensor]:
        """Computes reward, success and ends of transitions with other goals.

        Args:
            batch: Transitions, (m,).
            rows: Indices into the batch, (n,).
            goals: Goals of these rows, (n, *goal).

        Returns:
            New values by key, (n, 1) each: the reward and, if there are functions for
            them, the success and the ends.
        """
        achieved = batch.get(self.next_achieved_key).index_select(0, rows)
        stored_reward = batch.get(self.reward_key)
        reward = call_goal_function(self.reward_fn, achieved, goals, stored_reward)
        values = {self.reward_key: reward}
        if self.success_fn is not None:
            success = batch.get(self.success_key)
            values[self.success_key] = call_goal_function(
                self.success_fn, achieved, goals, success
            )
        if self.terminated_fn is not None:
            done, terminated = batch.get(DONE), batch.get(TERMINATED)
            # torchrl's ReplayBufferTrainer sets "truncated" in every row, probably by
            # mistake. "done" is true only where an episode ends, so a row counts as
            # truncated only if both are true. In data without "truncated", it counts if
            # it is done but not terminated.
            truncated = batch.get(TRUNCATED, ~terminated) & done

            def reaches(desired: Tensor) -> Tensor:
                assert self.terminated_fn is not None
                return call_goal_function(
                    self.terminated_fn, achieved, desired, terminated
                )

            # An episode that terminated without reaching its goal has failed. With
            # another goal it would fail too, so it stays terminated.
            has_failed = terminated.index_select(0, rows)
            if has_failed.any():
                stored_goals = batch.get(self.goal_key).index_select(0, rows)
                has_failed &= ~reaches(stored_goals)
            values[TERMINATED] = has_failed | reaches(goals)
            values[DONE] = values[TERMINATED] | truncated.index_select(0, rows)
        return values


def call_goal_function(
    function: GoalFunction, achieved: Tensor, desired: Tensor, stored: Tensor
) -> Tensor:
    """Calls a goal function and returns its values in the type of the stored entry.

    Args:
        function: `reward_fn`, `success_fn` or `terminated_fn`.
        achieved: Achieved goals, (n, *goal).
        desired: Desired goals, (n, *goal).
        stored: The entry that the values belong to, (m, 1).

    Raises:
        ValueError: The function did not return a tensor (n, 1).
    """
    with torch.no_grad():  # the function may be a learned network
        values = function(achieved, desired)
    expected_shape = (len(achieved), *stored.shape[1:])
    is_tensor = isinstance(values, Tensor)
    result = tuple(values.shape) if is_tensor else type(values).__name__
    if result != expected_shape:
        raise ValueError(
            "reward_fn, success_fn and terminated_fn must map (achieved_goal, "
            f"desired_goal), (n, *goal) each, to a tensor (n, 1): {function} should "
            f"return shape {expected_shape}, got {result}"
        )
    return values.to(stored.dtype)
