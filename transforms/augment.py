"""Hindsight goals at write time, as a transform of a replay buffer."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from torch_panda.transforms import base
from torch_panda.transforms.rewrite import GoalFunction
from torch_panda.transforms.strategies import DESIRED, RANDOM
from torch_panda.transforms.trajectories import Integers


class HindsightAugment(base.BufferTransform):
    """Stores every transition once more for each of k goals achieved in its episode.

    The paper's own way (Andrychowicz et al. 2017, arXiv 1707.01495, algorithm 1). An
    episode is held back until it ends; then `extend` stores its transitions and k
    relabelled copies of each, flat, under the same trajectory id.

    Args:
        reward_fn: see `BufferTransform`; called once an `extend`.
        k: number of relabelled copies of a transition.
        **options: as for `HindsightRelabel`; no strategy of other episodes.
    """

    def __init__(self, reward_fn: GoalFunction, *, k: int = 4, **options: Any) -> None:  # noqa: ANN401
        super().__init__(reward_fn, **options)
        if k < 1 or not float(k).is_integer():
            raise ValueError(f"k must be an integer of at least 1, got {k}.")
        if RANDOM in self._weights or DESIRED in self._weights:
            goals = f"cannot draw {self.strategy!r} goals; HindsightRelabel can"
            raise ValueError(f"HindsightAugment sees one episode at a time: {goals}.")
        self.k = k
        # Transitions of open trajectories: rows of a pool, and their serials, or -1.
        self._pool: Any = None
        self._serials: Integers = np.zeros(0, dtype=np.int64)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase | None:
        """Takes transitions in and returns those of the episodes that have ended.

        Raises:
            ValueError: it is one transition, without a dimension of time.
            RuntimeError: the buffer does not store rows one by one.
        """
        buffer, _ = base.find_buffer()
        if not tensordict.ndim:
            raise ValueError("`add` takes many rows for one item: use `extend`.")
        if base.samples_slices(buffer) or (
            buffer is not None and buffer.storage.ndim > 1
        ):
            raise RuntimeError(
                "HindsightAugment stores rows one by one: use ndim=1, and "
                'no slices but HindsightRelabel(unit="slice").'
            )
        self._rewriter.check(tensordict)
        with self._lock:
            count = self._memory.tracker.count
            oldest = self._serials[self._serials >= 0].min(initial=count)
            batch = self._note(tensordict, int(count - oldest), None)
            self._hold(batch.reshape(-1))
            rows = (self._serials >= 0).nonzero()[0]
            rows = rows[self._serials[rows].argsort()]  # in order of time
            trajectory, _ = self._memory.find(self._serials[rows])
            rows = rows[~np.isin(trajectory, [*self._memory.tracker.open.values()])]
            return self._augment(rows) if len(rows) else None

    def _hold(self, batch: TensorDictBase) -> None:
        """Copies transitions, (n,), into free rows of the pool, which may grow."""
        missing = len(batch) - int((self._serials < 0).sum())
        if missing > 0:
            missing = max(missing, len(self._serials))
            more = batch[:1].expand(missing).clone()
            pool = self._pool
            self._pool = more if pool is None else TensorDict.cat([pool, more])
            self._serials = np.append(self._serials, np.full(missing, -1))
        rows = (self._serials < 0).nonzero()[0][: len(batch)]
        self._pool[torch.from_numpy(rows)] = batch
        self._serials[rows] = batch.get(base.SERIAL_KEY).numpy(force=True)

    def _augment(self, rows: Integers) -> TensorDictBase:
        """Takes rows of whole episodes, (n,), out of the pool; returns (n * (1 + k),).

        They come first, in order, then k relabelled copies of each.
        """
        original = self._pool[torch.from_numpy(rows)]
        serial = self._serials[rows].repeat(self.k)
        self._serials[rows] = -1
        drawn = self._memory.draw(serial, self._weights, self._generator)
        goals = torch.from_numpy(drawn).to(original.get(base.SERIAL_KEY).device)
        copied = torch.arange(len(original), device="cpu").repeat_interleave(self.k)
        every = torch.arange(len(copied), device=goals.device)
        copies = self._rewriter.rewrite(original[copied], every, goals, is_own=True)
        return TensorDict.cat([original, copies]).exclude(base.SERIAL_KEY)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Leaves what is sampled as it is."""
        return tensordict

    def empty(self) -> None:
        """Drops the episodes held back, which the buffer's own `empty` does not."""
        super().empty()
        self._pool, self._serials = None, self._serials[:0]

    def get_extra_state(self) -> dict[str, Any]:
        """Returns the episodes held back and the generator, for `state_dict`."""
        held = (self._serials >= 0).nonzero()[0]
        rows = self._pool[torch.from_numpy(held)].to_dict() if len(held) else None
        return {**super().get_extra_state(), "held": rows}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Takes what `get_extra_state` returned."""
        super().set_extra_state(state)
        self._pool, self._serials = None, self._serials[:0]
        if (held := state["held"]) is not None:
            self._hold(TensorDict(held, [len(held[base.SERIAL_KEY])]))
