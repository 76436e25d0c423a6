"""Records the start of every episode and the actions since, for exact states.

Bullet remembers more than positions and velocities (see `bullet.broad_phase`). Only
repeating the actions from the start of the episode leads to the same state bit for bit.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_panda.bullet import BulletError

# An exact state has these keys in addition to those of a plain state.
START = "start_"  # prefix of the keys of the state at the start of the episode
ACTIONS = "actions"
NUM_ACTIONS = "num_actions"

# Steps that no running episode needs are dropped once there are more than this many.
_MAX_UNUSED_STEPS = 1000
# Longest episode that has an exact state [steps]. This limit bounds the memory of
# episodes that never end.
_MAX_STEPS = 20_000
# Replaces the index of an episode's first step after its actions were dropped.
_DROPPED = -1


class History:
    """Starts of the present episodes of n environments, and the actions since.

    Args:
        state: The tensors of the state, (n, ...) by key. They hold the starts of
            episodes whenever `begin` is called.
        action_dim: Size of an action.
    """

    def __init__(self, state: dict[str, Tensor], action_dim: int) -> None:
        self._start = {key: value.clone() for key, value in state.items()}
        # Pairs of arrays: indexing a tensor takes three times as long.
        self._start_arrays = [
            (self._start[key].numpy(), value.numpy()) for key, value in state.items()
        ]
        self._action_dim = action_dim
        # Actions (n, action_dim), and a mask (n, 1) of the environments that took them;
        # None means all.
        self._steps: list[tuple[Tensor, Tensor | None]] = []
        # Index in _steps of the first step of each environment's episode.
        self._first_steps = [0] * len(next(iter(state.values())))

    def begin(self, envs: Sequence[int]) -> None:
        """Record the starts of the episodes that begin in these environments."""
        for start, present in self._start_arrays:
            for env in envs:
                start[env] = present[env]
        for env in envs:
            self._first_steps[env] = len(self._steps)
        if self._count_unused_steps() > _MAX_UNUSED_STEPS:
            self._delete_unused_steps()

    def record(self, action: Tensor, step_mask: Tensor | None) -> None:
        """Record a step.

        Args:
            action: (n, action_dim) float32. The caller must not change it later.
            step_mask: Mask of the environments that take the step, (n, 1) bool; None
                means all.
        """
        if len(self._steps) == _MAX_STEPS:
            self._delete_unused_steps()
        if len(self._steps) == _MAX_STEPS:
            # Forget the episodes that need the oldest step.
            self._first_steps = [first or _DROPPED for first in self._first_steps]
            self._delete_unused_steps()
        self._steps.append((action, None if step_mask is None else step_mask.clone()))

    def _count_unused_steps(self) -> int:
        """Count the steps at the beginning of the list that no episode needs."""
        needed = (first for first in self._first_steps if first != _DROPPED)
        return min(needed, default=len(self._steps))

    def _delete_unused_steps(self) -> None:
        unused = self._count_unused_steps()
        del self._steps[:unused]
        self._first_steps = [
            first if first == _DROPPED else first - unused
            for first in self._first_steps
        ]

    def export(self) -> dict[str, Tensor]:
        """The recorded starts and actions.

        Returns:
            The starts under keys with the prefix ``start_``, ``actions`` (n, k,
            action_dim) and ``num_actions`` (n, 1). Row i of ``actions`` holds the
            ``num_actions[i]`` actions of environment i, followed by zeros.

        Raises:
            BulletError: An episode is too long for its actions to be kept.
        """
        first_steps = self._first_steps
        if too_long := [i for i, first in enumerate(first_steps) if first == _DROPPED]:
            raise BulletError(
                f"the episodes of environments {too_long} are too long for an exact "
                f"state, which holds at most {_MAX_STEPS} actions"
            )
        begins = torch.tensor(first_steps, device="cpu")
        oldest = int(begins.min())
        steps = self._steps[oldest:]
        # By step: a mask of the environments that took it in their present episode.
        took_step = [
            (begins <= index)
            if step_mask is None
            else (begins <= index) & step_mask.flatten()
            for index, (_, step_mask) in enumerate(steps, start=oldest)
        ]
        counts = torch.zeros(len(begins), dtype=torch.int64, device="cpu")
        longest = int(sum(took_step, start=counts).max())
        shape = (len(begins), longest, self._action_dim)
        actions = torch.zeros(shape, dtype=torch.float32, device="cpu")
        for (action, _), mask in zip(steps, took_step, strict=True):
            rows = mask.nonzero().flatten()
            actions[rows, counts[rows]] = action[rows]
            counts[rows] += 1
        start = {START + key: value.clone() for key, value in self._start.items()}
        return {**start, ACTIONS: actions, NUM_ACTIONS: counts.unsqueeze(1)}
