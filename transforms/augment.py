"""Hindsight goals at write time, as a transform of a replay buffer."""

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from torch_panda.transforms import base
from torch_panda.transforms.rewrite import GoalFunction
from torch_panda.transforms.strategies import DESIRED, RANDOM


class HindsightAugment(base.BufferTransform):
    """Stores every transition once more for each of k goals achieved in its episode.

    The paper's own way (Andrychowicz et al. 2017, arXiv 1707.01495, algorithm 1). An
    episode is held back until it ends; then `extend` stores its transitions and k
    relabelled copies of each, flat, under the same trajectory id.

    Args:
        reward_fn: see `BufferTransform`; called once an `extend`.
        k: number of relabelled copies of a transition.
        **options: of `BufferTransform`; no strategy of other episodes.
    """

    def __init__(self, reward_fn: GoalFunction, *, k: int = 4, **options: Any) -> None:  # noqa: ANN401
        super().__init__(reward_fn, **options)
        if k < 1 or not float(k).is_integer():
            raise ValueError(f"k must be an integer of at least 1, got {k}.")
        if RANDOM in self._weights or DESIRED in self._weights:
            goals = f"cannot draw {self.strategy!r} goals; HindsightRelabel can"
            raise ValueError(f"HindsightAugment sees one episode at a time: {goals}.")
        self.k = k
        self._held: list[TensorDictBase] = []  # batches; the first has the oldest row

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase | None:
        """Takes transitions in and returns those of the episodes that have ended."""
        buffer, method = base.find_buffer()
        if method == "add" or not tensordict.ndim:
            raise ValueError("`add` takes many rows for one item: use `extend`.")
        ndim = 1 if buffer is None else buffer.storage.ndim
        if ndim > 1 or base.samples_slices(buffer):
            raise RuntimeError(
                "HindsightAugment stores rows one by one: use ndim=1, and "
                'no slices but HindsightRelabel(unit="slice").'
            )
        with self._lock:
            stored = 0
            if self._held:
                stored = self._memory.count - int(self._held[0][base.SERIAL_KEY].min())
            batch = self._note(tensordict, stored)
            self._held.append(batch.reshape(-1).to_tensordict())  # dense, and a copy
            serials = [b.get(base.SERIAL_KEY).numpy(force=True) for b in self._held]
            is_open = self._memory.is_open(np.concatenate(serials))
            if is_open.all():
                return None
            held, stays = TensorDict.cat(self._held), torch.from_numpy(is_open)
            self._held = [held[stays]] if is_open.any() else []
            ended = held[~stays]
            ended = ended[ended.get(base.SERIAL_KEY).argsort()]  # in order of time
            copies = ended.repeat_interleave(self.k, dim=0)
            tag = copies.get(base.SERIAL_KEY)
            serial, weights = tag.numpy(force=True), self._weights
            drawn = self._memory.draw(serial, weights, self._generator)
        goals = torch.from_numpy(drawn).to(tag.device)
        rows = torch.arange(len(tag), device=tag.device)
        copies = self._rewriter.rewrite(copies, rows, goals, is_own=True)
        return TensorDict.cat([ended, copies]).exclude(base.SERIAL_KEY)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Leaves what is sampled as it is."""
        return tensordict

    def empty(self) -> None:
        """Drops the episodes held back, which the buffer's own `empty` does not."""
        super().empty()
        self._held = []

    def get_extra_state(self) -> dict[str, Any]:
        """Returns the episodes held back and the generator, for `state_dict`."""
        held = TensorDict.cat(self._held).to_dict() if self._held else None
        return {**super().get_extra_state(), "held": held}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Takes what `get_extra_state` returned."""
        super().set_extra_state(state)
        held = state["held"]
        self._held = [TensorDict(held, [len(held[base.SERIAL_KEY])])] if held else []
