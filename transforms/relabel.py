"""Hindsight goals at sample time, as a transform of a replay buffer."""

import warnings
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import ReplayBuffer, ReplayBufferEnsemble, RoundRobinWriter

from torch_panda.transforms import base
from torch_panda.transforms.goal_memory import Goals
from torch_panda.transforms.rewrite import GoalFunction
from torch_panda.transforms.strategies import LOOKING_AHEAD, Integers, draw_uniform


class HindsightRelabel(base.BufferTransform):
    """Gives sampled transitions goals that their trajectory achieved later.

    Hindsight experience replay (Andrychowicz et al. 2017, arXiv 1707.01495): a random
    `her_ratio` of the rows is relabelled; the others come out as they were stored.
    Goals are what a step achieved, of the same episode: "future" (this step or later),
    "final" (the last), "episode" (any); of any other: "random"; or "desired", what any
    stored transition was asked for. README.md beside this file is a guide.

    Args:
        reward_fn: maps (achieved_goal, desired_goal), (n, *goal) each, to (n, 1).
        her_ratio: fraction of rows to relabel: k / (k + 1) for the paper's k goals.
        unit: "row" draws a goal a row, "slice" one for all rows of a slice, drawn for
            its last row. A `SliceSampler` puts old ends back unless truncated_key=None.
        capacity: transitions to remember where no buffer calls, which would tell it.
        goal_parts: sizes of the parts of a goal vector, e.g. (3, 3), each of which is
            relabelled for itself, at her_ratio (Lanier et al. 2019, arXiv 1906.03710).
        **options: of `BufferTransform`, which are the same for `HindsightAugment`.

    Raises:
        ValueError: an argument is none of what is accepted, which the message names.
    """

    def __init__(
        self,
        reward_fn: GoalFunction,
        *,
        her_ratio: float = 0.8,
        unit: Literal["row", "slice"] = "row",
        capacity: int | None = None,
        goal_parts: tuple[int, ...] | None = None,
        **options: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(reward_fn, **options)
        if not 0 <= her_ratio <= 1:
            raise ValueError(f"her_ratio must be within [0, 1], got {her_ratio}.")
        if unit not in ("row", "slice"):
            raise ValueError(f'unit must be "row" or "slice", got {unit!r}.')
        if capacity is not None and (capacity < 1 or not float(capacity).is_integer()):
            raise ValueError(f"capacity must be a positive integer, got {capacity}.")
        if goal_parts is not None and (not goal_parts or min(goal_parts) < 1):
            raise ValueError(f"goal_parts must be positive sizes, got {goal_parts!r}.")
        self.her_ratio, self.unit = her_ratio, unit
        self.capacity, self.goal_parts = capacity, goal_parts
        self._looks_ahead = all(name in LOOKING_AHEAD for name in self._weights)
        self._check_sampled = base.DataCheck(self._rewriter)  # behind other transforms
        self._is_first_sample = True
        self._last_write = 0, 0  # rows stored before it, and its own

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Notes the transitions that are about to be stored."""
        buffer, method = base.find_buffer()
        is_item = not tensordict.ndim  # one step
        if buffer is not None:
            ndim, writer = buffer.storage.ndim, type(buffer.writer)
            fits = tensordict.ndim in (ndim - 1, ndim) and buffer.dim_extend == ndim - 1
            one_item = method == "add" and tensordict.shape[ndim - 1 :].numel() > 1
            if one_item or not fits or not issubclass(writer, RoundRobinWriter):
                raise RuntimeError(
                    f"rows must be written round-robin (here: {writer.__name__}) in "
                    f"order of time; got {list(tensordict.shape)} for ndim={ndim}: "
                    "extend with data.reshape(-1), or use several dimensions, ndim=2 "
                    "for [num_envs, time] (of collectors with replay_buffer=)."
                )
            is_item = tensordict.ndim < ndim
        batch = tensordict.unsqueeze(-1) if is_item else tensordict
        with self._lock:
            self._last_write = self._stored(buffer), batch.numel()
            batch = self._note(batch, self._last_write[0])
        return batch.squeeze(-1) if is_item else batch

    def _stored(self, buffer: ReplayBuffer | None) -> int:
        # An ensemble samples the rows of several buffers: which one's is not known.
        if buffer is not None and not isinstance(buffer, ReplayBufferEnsemble):
            return len(buffer.storage)
        return min(count := self._memory.count, self.capacity or count)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Relabels rows that a buffer has sampled."""
        tag = tensordict.get(base.SERIAL_KEY, None)
        buffer, method = base.find_buffer()
        if self._is_first_sample:
            self._is_first_sample = False
            if self.unit == "row" and base.samples_slices(buffer):
                cure = 'pass unit="slice" for one goal a slice'
                warnings.warn(f"the rows of a slice have several goals: {cure}.")  # noqa: B028
        with self._lock:
            stored, (before, number) = self._stored(buffer), self._last_write
            size = 0 if buffer is None else getattr(buffer.storage, "max_size", 0)
            if stored == before < size:  # what was noted has not been written yet
                stored += number
            floor = self._memory.count - stored
            if tag is None or floor < 0:
                raise (KeyError if tag is None else RuntimeError)(
                    "HindsightRelabel must be in the buffer before the first extend(), "
                    "or its rows be noted by prepare()."
                )
            if not self._looks_ahead:
                self._memory.free(floor)
            self._check_sampled(tensordict)
            rows, goals = self._draw(tag.numpy(force=True).reshape(-1), tensordict)
        if not len(rows):
            return tensordict.exclude(base.SERIAL_KEY)
        index, new = (torch.from_numpy(x).to(tag.device) for x in (rows, goals))
        # Others may hand out their storage, or tensors that are stacked when asked for.
        is_own = method == "_sample" and type(tensordict) is TensorDict
        is_own = is_own and tensordict.ndim == 1
        batch = self._rewriter.rewrite(tensordict, index, new, is_own=is_own)
        return batch.del_(base.SERIAL_KEY)

    def _draw(self, serial: Integers, batch: TensorDictBase) -> tuple[Integers, Goals]:
        """Draws rows of a batch of serials, (n,), and their new goals, (n, *goal)."""
        last, unit = serial, None  # the last rows of units; the unit of every row
        if self.unit == "slice":
            trajectory, place = self._memory.find(serial.clip(self._memory.freed))
            goes_on = (np.diff(trajectory) == 0) & np.isin(np.diff(place), (0, 1))
            is_last = np.append(~goes_on, True)
            last, unit = serial[is_last], is_last.cumsum() - is_last
        if self.goal_parts is None:
            return self._draw_once(serial, last, unit)
        own = batch.get(self._rewriter.goal_key)
        goals = own.reshape(-1, own.shape[-1]).numpy(force=True).copy()
        is_new = np.zeros(len(goals), dtype=bool)
        for end, size in zip(np.cumsum(self.goal_parts), self.goal_parts, strict=True):
            rows, drawn = self._draw_once(serial, last, unit)
            goals[rows, end - size : end] = drawn[:, end - size : end]
            is_new[rows] = True
        return is_new.nonzero()[0], goals[is_new]

    def _draw_once(
        self, serial: Integers, last: Integers, unit: Integers | None
    ) -> tuple[Integers, Goals]:
        """Draws units, and a goal for each; returns their rows and the rows' goals."""
        chosen: Any = draw_uniform(len(last), self._generator) < self.her_ratio
        overwritten = serial < self._memory.freed  # since they were sampled
        chosen[overwritten if unit is None else unit[overwritten]] = False
        units = chosen.nonzero()[0]
        goals = self._memory.draw(last.take(units), self._weights, self._generator)
        if unit is None:
            return units, goals
        rows = chosen[unit].nonzero()[0]
        return rows, goals[(chosen.cumsum() - 1)[unit[rows]]]

    def prepare(self, data: TensorDictBase) -> TensorDictBase:
        """Notes transitions that exist already: a data set, or a buffer's storage.

        They have trajectory ids, or are [trajectories, time]. Returns them flat and
        with a tag, for the `TensorStorage` of a buffer with this transform.
        """
        if self._memory.count:
            raise RuntimeError("prepare() must come before other transitions.")
        flat = data.reshape(-1)
        noted = flat.copy()
        if data.ndim > 1 and data.get(self.trajectory_key, None) is None:
            row = torch.arange(len(flat), device="cpu") // data.shape[-1]
            noted.set(self.trajectory_key, row)
        with self._lock:
            tag = self._note(noted, 0).get(base.SERIAL_KEY)
        self.end_trajectories()
        return flat.copy().set(base.SERIAL_KEY, tag)
