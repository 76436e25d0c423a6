"""Exact states: the start of every episode, and the actions since.

Bullet remembers more than positions and velocities (see `bullet.broad_phase`). Only
repeating the actions from the start of the episode leads to the same state bit for bit.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_panda.bullet import BulletError
from torch_panda.checks import check_rows
from torch_panda.envs.state import ACTIONS, EXACT_KEYS, NUM_ACTIONS, START, read_entry

# Steps that no running episode needs are dropped once there are more than this many.
_MAX_UNUSED_STEPS = 1000
# Longest episode that has an exact state [steps]. This limit bounds the memory of
# episodes that never end.
_MAX_STEPS = 20_000
# Stands for the first step of an episode whose actions were dropped.
_DROPPED = -1

TakeStep = Callable[[Tensor, Tensor, list[int]], None]
"""Takes a step, given actions (n, action_dim), a mask (n, 1) of the environments that
act, and the environments for which this step is the last of the replay."""


class Replay(NamedTuple):
    """The actions that lead k environments to an exact state.

    Attributes:
        envs: The environments.
        start: State at the start of their episodes, (k, ...) by key.
        end: State to which the actions lead, (k, ...) by key.
        actions: (k, length, action_dim) float32 in [-1, 1].
        num_actions: Number of actions of each row, (k,) int64.
    """

    envs: list[int]
    start: dict[str, Tensor]
    end: dict[str, Tensor]
    actions: Tensor
    num_actions: Tensor

    def run(self, take_step: TakeStep, state: Mapping[str, Tensor]) -> None:
        """Repeat the actions, and check that they lead to the state.

        Args:
            take_step: Takes one step in some of the environments.
            state: The present state of all environments, (n, ...) by key.

        Raises:
            ValueError: An entry of the state differs.
        """
        rows = torch.tensor(self.envs, device="cpu")
        num_envs = len(next(iter(state.values())))
        for index in range(max(self.num_actions.tolist(), default=0)):
            is_acting = self.num_actions > index
            action = self.actions.new_zeros(num_envs, self.actions.shape[-1])
            action[rows[is_acting]] = self.actions[is_acting, index]
            mask = torch.zeros(num_envs, 1, dtype=torch.bool, device="cpu")
            mask[rows[is_acting]] = True
            take_step(action, mask, rows[self.num_actions == index + 1].tolist())
        state["step_count"][self.envs] = self.end["step_count"]
        for key, value in state.items():
            differs = (value[self.envs] != self.end[key]).flatten(1).any(dim=1)
            if differs.any():
                env = self.envs[int(differs.nonzero()[0])]
                raise ValueError(
                    f"the actions in the exact state of environment {env} do not lead "
                    f"to its {key}: the state was changed or comes from an environment "
                    f"with other physics; to start from its poses and velocities, "
                    f"leave out num_actions, actions and the entries that begin with "
                    f"start_"
                )


class ExactStates:
    """Starts of the present episodes of n environments, and the actions since.

    Args:
        state: The tensors of the state, (n, ...) by key. Before each call of `begin`,
            they must hold the starts of the episodes.
        action_dim: Size of an action.
    """

    def __init__(self, state: Mapping[str, Tensor], action_dim: int) -> None:
        self._start = {key: value.clone() for key, value in state.items()}
        # Pairs of arrays: indexing a tensor takes three times as long.
        self._start_arrays = [
            (self._start[key].numpy(), value.numpy()) for key, value in state.items()
        ]
        self._action_dim = action_dim
        # Actions (n, action_dim); a mask (n, 1) of the environments that took them,
        # where None means all; and the robot's action_scale.
        self._steps: list[tuple[Tensor, Tensor | None, float]] = []
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

    def record(
        self, action: Tensor, step_mask: Tensor | None, action_scale: float
    ) -> None:
        """Record a step.

        Args:
            action: (n, action_dim) float32. The caller must not change it later.
            step_mask: Mask of the environments that take the step, (n, 1) bool; None
                means all.
            action_scale: The robot's ``action_scale`` in this step.
        """
        if len(self._steps) == _MAX_STEPS:
            self._delete_unused_steps()
        if len(self._steps) == _MAX_STEPS:
            # Forget the episodes that need the oldest step.
            self._first_steps = [first or _DROPPED for first in self._first_steps]
            self._delete_unused_steps()
        mask = None if step_mask is None else step_mask.clone()
        self._steps.append((action, mask, action_scale))

    def export(self, action_scale: float) -> dict[str, Tensor]:
        """The recorded starts and actions.

        Args:
            action_scale: The robot's present ``action_scale``.

        Returns:
            The starts under keys with the prefix ``start_``, ``actions`` (n, k,
            action_dim) and ``num_actions`` (n, 1). Row i of ``actions`` holds the
            ``num_actions[i]`` actions of environment i, followed by zeros.

        Raises:
            BulletError: An episode is too long for its actions to be kept, or has steps
                with another ``action_scale``.
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
            for index, (_, step_mask, _) in enumerate(steps, start=oldest)
        ]
        counts = torch.zeros(len(begins), dtype=torch.int64, device="cpu")
        longest = int(sum(took_step, start=counts).max())
        shape = (len(begins), longest, self._action_dim)
        actions = torch.zeros(shape, dtype=torch.float32, device="cpu")
        for (action, _, scale), mask in zip(steps, took_step, strict=True):
            rows = mask.nonzero().flatten()
            if scale != action_scale and len(rows):
                raise BulletError(
                    f"action_scale changed from {scale} to {action_scale} during the "
                    f"episodes of environments {rows.tolist()}, so their states cannot "
                    f"be exact: change it between a reset and the first step"
                )
            actions[rows, counts[rows]] = action[rows]
            counts[rows] += 1
        start = {START + key: value.clone() for key, value in self._start.items()}
        return {**start, ACTIONS: actions, NUM_ACTIONS: counts.unsqueeze(1)}

    def read(
        self,
        state: Mapping[str, Any],
        values: dict[str, Tensor],
        envs: list[int],
        batch_shape: tuple[int, ...],
    ) -> Replay | None:
        """Check the entries that only an exact state has.

        Args:
            state: Tensors of shape (*batch_shape, ...) by key.
            values: The plain entries of this state, (len(envs), ...) by key.
            envs: The environments that start from the state.
            batch_shape: Batch shape of the environment.

        Returns:
            The actions to repeat; None for a plain state.

        Raises:
            ValueError: The exact state lacks entries, or an entry is wrong.
        """
        exact_keys = EXACT_KEYS.intersection(state.keys())
        if not exact_keys:
            return None
        required = {START + key for key in self._start} | {ACTIONS, NUM_ACTIONS}
        if missing := (required | self._start.keys()).difference(state.keys()):
            raise ValueError(
                f"an exact state needs all its entries, but {sorted(missing)} are "
                f"missing; leave out {sorted(exact_keys)} to start from the other "
                f"entries"
            )

        def read(key: str, like: Tensor) -> Tensor:
            return read_entry(key, state[key], batch_shape, like, envs)

        n, shape = len(self._first_steps), state[ACTIONS].shape
        length = shape[-2] if len(shape) > 1 else 1
        like = torch.zeros(
            n, length, self._action_dim, dtype=torch.float32, device="cpu"
        )
        actions = read(ACTIONS, like)
        check_rows(ACTIONS, actions.abs() <= 1, envs, "in [-1, 1]")
        count = read(NUM_ACTIONS, torch.zeros(n, 1, dtype=torch.int64, device="cpu"))
        check_rows(NUM_ACTIONS, count <= length, envs, f"at most {length}")
        start = {key: read(START + key, now) for key, now in self._start.items()}
        return Replay(envs, start, values, actions, count.flatten())

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
