"""Base of the transforms that draw goals when a buffer is sampled."""

import warnings
from abc import abstractmethod
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl import envs
from torchrl.data import ReplayBuffer, ReplayBufferEnsemble, RoundRobinWriter

from torch_panda.transforms.base import SERIAL_KEY, BufferTransform
from torch_panda.transforms.buffer import find_buffer, get_chain, samples_slices
from torch_panda.transforms.rewrite import DONE, GoalFunction
from torch_panda.transforms.strategies import Integers


class SampleTimeTransform(BufferTransform):
    """Remembers stored transitions, and draws goals for sampled transitions.

    On writing, the transform adds a serial number to each transition. On sampling, the
    serial numbers say where the sampled rows are in their trajectories.

    Args:
        reward_fn: See `BufferTransform`.
        unit: Rows that share a goal. "row" draws a goal for each row. "slice" draws one
            goal for all rows of a sampled slice. It is drawn for the last of these
            rows, so that a "future" goal lies in the future of all of them.
        capacity: Number of transitions to remember, for a transform that is called
            without a buffer or in a `ReplayBufferEnsemble`. None remembers as
            many as the buffer holds.
        **options: Other arguments of `BufferTransform`.
    """

    def __init__(
        self,
        reward_fn: GoalFunction,
        *,
        unit: Literal["row", "slice"] = "row",
        capacity: int | None = None,
        **options: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(reward_fn, **options)
        if unit not in ("row", "slice"):
            raise ValueError(f'unit must be "row" or "slice", got {unit!r}')
        if capacity is not None and (capacity < 1 or not float(capacity).is_integer()):
            raise ValueError(f"capacity must be a positive integer, got {capacity}")
        self.unit = unit
        self.capacity = None if capacity is None else int(capacity)
        self._is_first_sample = True
        # Number of transitions in the buffer before the last write, and number of
        # transitions of this write.
        self._last_write = 0, 0

    @torch.compiler.disable  # a compiled loop may write too; see `forward`
    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Remembers the transitions that are about to be stored."""
        buffer, method = find_buffer()
        mask = self._find_mask(tensordict)
        is_one_item = not tensordict.ndim
        if buffer is not None:
            _check_layout(buffer, method, tensordict, is_padded=mask is not None)
            is_one_item = tensordict.ndim < buffer.storage.ndim
        batch = tensordict if mask is None else tensordict[mask]
        if is_one_item:
            batch = batch.unsqueeze(-1)
        with self._lock:
            self._claim(buffer)
            stored = self._count_stored(buffer)
            self._check_last_write(buffer, stored)
            self._last_write = stored, batch.shape.numel()
            batch = self._remember(batch, stored)  # type: ignore[arg-type]  # rows
        return batch.squeeze(-1) if is_one_item else batch

    def _forget(self) -> None:
        super()._forget()
        self._last_write = 0, 0

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restores the state that `get_extra_state` returned."""
        super().set_extra_state(state)
        self._last_write = 0, 0

    def _count_stored(self, buffer: ReplayBuffer | None) -> int:
        """Returns how many transitions the buffer holds."""
        if buffer is not None and not isinstance(buffer, ReplayBufferEnsemble):
            return len(buffer.storage)
        # Without a buffer, take the newest `capacity` transitions as stored. Do the
        # same for an ensemble, because it does not say from which of its buffers it
        # samples.
        count = self._memory.count
        return min(count, self.capacity or count)

    def _check_last_write(self, buffer: ReplayBuffer | None, stored: int) -> None:
        """Checks that the buffer has appended all rows of the last write.

        Otherwise the memory counts rows that the buffer does not hold, and takes rows
        that it does hold for overwritten ones, which keep their goals.

        Args:
            buffer: The buffer.
            stored: Number of transitions in the buffer.

        Raises:
            RuntimeError: Some of the rows are missing, or replaced other rows.
        """
        if buffer is None or isinstance(buffer, ReplayBufferEnsemble):
            return
        before, written = self._last_write
        added = stored - before
        expected = min(written, buffer.storage.max_size - before)
        if 0 < added < expected and buffer.storage.ndim == 1:
            name = type(self).__name__
            raise RuntimeError(
                f"{written} rows passed through {name}, but the buffer has appended "
                f"only {added}: put transforms that drop rows after {name}; do not use "
                "a ConsumingSampler or consume_after_n_samples"
            )

    # A compiled loss may sample. `torch.compile` cannot trace numpy code whose sizes
    # vary from batch to batch, so break the graph here. This also keeps the call stack
    # that `find_buffer` reads.
    @torch.compiler.disable
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Gives sampled transitions other goals."""
        buffer, method = find_buffer()
        batch = tensordict.reshape(-1)
        # The buffer's `_sample` returns a copy, which may be changed in place. Other
        # methods of the buffer may return the storage itself, or a lazy stack.
        if method != "_sample" or type(tensordict) is not TensorDict:
            batch = batch.to_tensordict()
        tags = batch.get(SERIAL_KEY, None)
        with self._lock:
            oldest = self._find_oldest(buffer)
            if tags is None or oldest < 0:
                raise self._explain_unknown_rows(has_tags=tags is not None)
            is_first, self._is_first_sample = self._is_first_sample, False
            if is_first:
                self._rewriter.check_entries(batch)
                self._warn_of_slices(buffer)
            self._check_sampled(batch, keeps_rows=self._keeps_rows)
            # A strategy that looks ahead never draws an overwritten step.
            if not all(m.only_looks_ahead for m in self._get_mixtures()):
                self._memory.forget(oldest)
            serials = tags.numpy(force=True)
            # One buffer of an ensemble may hold rows of another transform.
            if is_first or isinstance(buffer, ReplayBufferEnsemble):
                self._check_tags(serials, batch)
            drawn = self._draw(serials, batch)
        self._write(batch, drawn)
        return batch.del_(SERIAL_KEY).reshape(tensordict.shape)

    def _check_tags(self, serials: Integers, batch: TensorDictBase) -> None:
        """Checks that this transform has tagged the sampled rows.

        Raises:
            RuntimeError: Most rows achieved another goal than the transitions that the
                transform remembers under their serial numbers.
        """
        known = serials >= self._memory.oldest
        achieved = batch.get(self._rewriter.next_achieved_key)
        achieved = achieved[torch.from_numpy(known).to(achieved.device)]
        remembered = torch.from_numpy(self._memory.get_achieved(serials[known]))
        differs = achieved != remembered.to(achieved)
        differs &= ~achieved.isnan()
        if differs.flatten(1).any(1).sum() > len(achieved) / 2:
            raise RuntimeError(
                f"the sampled rows passed through another {type(self).__name__} when "
                "they were stored: sample them with that transform, or pass all of "
                "them through this one"
            )

    @abstractmethod
    def _draw(self, serials: Integers, batch: TensorDictBase) -> Any:  # noqa: ANN401
        """Draws goals for a batch (n,). The caller holds the lock."""

    @abstractmethod
    def _write(self, batch: TensorDictBase, drawn: Any) -> None:  # noqa: ANN401
        """Writes the goals that `_draw` returned into a batch (n,)."""

    def _find_oldest(self, buffer: ReplayBuffer | None) -> int:
        """Returns the serial number of the oldest transition that the buffer holds.

        It is negative if the buffer holds transitions that were not remembered.
        """
        stored, (before, written) = self._count_stored(buffer), self._last_write
        size = 0 if buffer is None else getattr(buffer.storage, "max_size", 0)
        # Another thread may be in the middle of `extend`. Then the memory already
        # counts the new transitions, but the storage does not, so add them. (The length
        # of a full storage never grows.)
        if stored == before < size:
            stored += written
        return self._memory.count - stored

    def _find_units(self, serials: Integers) -> tuple[Integers, Integers | None]:
        """Groups rows into units, which are rows or slices. Each unit gets one goal.

        Returns:
            Serial number of the last row of each unit, (m,). Index of each row's unit,
            (n,), or None if each row is a unit.
        """
        if self.unit == "row":
            return serials, None
        numbers, steps = self._memory.find(serials.clip(self._memory.oldest))
        # A slice continues with the next step, or with the same one where a sampler
        # repeats it to pad a short slice.
        continues = (np.diff(numbers) == 0) & np.isin(np.diff(steps), (0, 1))
        is_last = np.append(~continues, True)
        return serials[is_last], is_last.cumsum() - is_last

    def _explain_unknown_rows(self, *, has_tags: bool) -> Exception:
        """Returns the error for sampled rows that are not in the memory."""
        name = type(self).__name__
        chain = get_chain(self)
        selecting = [
            type(transform).__name__
            for transform in chain[: chain.index(self)]
            if isinstance(transform, (envs.SelectTransform, envs.ExcludeTransform))
        ]
        if selecting and not has_tags:
            return KeyError(
                f"{SERIAL_KEY!r} is missing in the sampled batch, because "
                f"{' and '.join(selecting)} comes before {name} in the buffer: put it "
                f"after {name}"
            )
        message = (
            f"{name} must be in the buffer before the first extend(); pass rows that "
            "are stored already through prepare()"
        )
        return RuntimeError(message) if has_tags else KeyError(message)

    def _warn_of_slices(self, buffer: ReplayBuffer | None) -> None:
        """Warns if the buffer samples slices, but each row gets a goal of its own."""
        if self.unit == "row" and samples_slices(buffer):
            warnings.warn(
                'each row of a slice gets a goal of its own: pass unit="slice" for one '
                "goal per slice",
                stacklevel=2,
            )

    def _check_order(self, data: TensorDictBase) -> None:
        """Checks that most transitions of a data set continue the one before them.

        Raises:
            ValueError: Most transitions begin a new trajectory, although the last
                transition with the same id did not end one.
        """
        ids = data.get(self.trajectory_key, None)
        num_ids = 1 if ids is None else len(ids.unique())
        num_begun = num_ids + int(data.get(DONE).sum())
        steps = self._memory.find(np.arange(len(data)))[1]
        if (steps == 0).sum() > num_begun + len(data) / 2:
            self._forget()
            raise ValueError(
                f"the {self._rewriter.achieved_goal_key!r} of most transitions is not "
                "the goal that the transition before them with the same id achieved: "
                "pass whole trajectories in the order of time, not shuffled rows"
            )

    def prepare(self, data: TensorDictBase) -> TensorDictBase:
        """Remembers stored transitions, such as those of a data set.

        Args:
            data: Transitions with trajectory ids, or of batch shape [trajectories,
                time].

        Returns:
            The transitions in one dimension, with serial numbers. Put them into the
            `TensorStorage` of a buffer with this transform. The tensors are not copied.

        Raises:
            RuntimeError: The transform has remembered other transitions before.
            ValueError: There are no transitions, or most of them are not in the order
                of time.
        """
        if not data.shape.numel():
            raise ValueError(f"there are no transitions in data {list(data.shape)}")
        if self._memory.count:
            raise RuntimeError(
                "prepare() must come before any extend(): make a new transform, or "
                "call empty() first"
            )
        flat = data.reshape(-1)
        identified = flat.copy()
        if data.ndim > 1 and data.get(self.trajectory_key, None) is None:
            ids = torch.arange(len(flat), device="cpu") // data.shape[-1]
            identified.set(self.trajectory_key, ids)
        mask = self._find_mask(data)
        if mask is not None:
            flat, identified = flat[mask.reshape(-1)], identified[mask.reshape(-1)]
        with self._lock:
            tags = self._remember(identified, 0).get(SERIAL_KEY)
            self._check_order(identified)
        self.end_trajectories()
        return flat.copy().set(SERIAL_KEY, tags)


def _check_layout(
    buffer: ReplayBuffer, method: str, data: TensorDictBase, *, is_padded: bool
) -> None:
    """Checks that the buffer writes these transitions in order of time.

    Args:
        buffer: The buffer.
        method: Method of the buffer that is writing: "add" or "extend".
        data: The transitions.
        is_padded: Whether some rows are padding.

    Raises:
        RuntimeError: The buffer would write them in another order, or the data have
            padding that cannot be removed.
    """
    ndim, writer = buffer.storage.ndim, type(buffer.writer)
    if is_padded and not ndim == data.ndim == 1:
        raise RuntimeError(
            "padded rows (split_trajs=True) can only be removed from data [time] for a "
            f"storage of ndim=1, got data {list(data.shape)} and ndim={ndim}: extend a "
            "storage of ndim=1 with data.reshape(-1), or do not split trajectories"
        )
    if not issubclass(writer, RoundRobinWriter):
        raise RuntimeError(
            "the writer must be round-robin, so that rows are in order of time, got "
            f"{writer.__name__}: make the buffer without writer="
        )
    if buffer.dim_extend != ndim - 1:
        raise RuntimeError(
            "the last dimension of a storage must be time, got dim_extend="
            f"{buffer.dim_extend} for ndim={ndim}: make the buffer without dim_extend="
        )
    if data.ndim != ndim and (method != "add" or data.ndim != ndim - 1):
        raise RuntimeError(
            f"data {list(data.shape)} for ndim={ndim} must have as many dimensions as "
            "the storage: call extend(data.reshape(-1)) with ndim=1, or use ndim=2 for "
            "data [num_envs, time], such as those of a collector with replay_buffer="
        )
    if method == "add" and data.shape[ndim - 1 :].numel() > 1:
        raise RuntimeError(
            f"add() writes a single step, got data {list(data.shape)} for ndim={ndim}: "
            "call extend(); a collector with replay_buffer= needs ndim=2 and "
            "extend_buffer=True"
        )
