"""HindsightAugment: stores each episode together with relabelled copies of it."""

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from torch_panda.transforms.base import SERIAL_KEY, BufferTransform
from torch_panda.transforms.buffer import find_buffer, samples_slices
from torch_panda.transforms.rewrite import GoalFunction
from torch_panda.transforms.strategies import DESIRED, RANDOM


class HindsightAugment(BufferTransform):
    """Stores k relabelled copies of every transition when its episode ends.

    This is algorithm 1 of the HER paper (Andrychowicz et al. 2017, arXiv 1707.01495).
    The transform holds back the transitions of an episode until the episode ends. The
    `extend` that brings the last transition then stores the whole episode, and k copies
    of each transition with hindsight goals. A copy keeps the trajectory id of its
    transition. The stored rows have one dimension, whatever the shape of the data.

    Args:
        reward_fn: See `BufferTransform`. Each `extend` computes the rewards of all
            copies in one call. The first batches cause further calls, which check the
            stored rewards.
        k: Number of relabelled copies of each transition.
        **options: Other arguments of `BufferTransform`. The strategies "random" and
            "desired" are refused, because they take goals from other episodes.

    Raises:
        TypeError: An argument is unknown.
        ValueError: An argument has a value that is not accepted.
    """

    _shown = ("strategy", "k")

    def __init__(self, reward_fn: GoalFunction, *, k: int = 4, **options: Any) -> None:  # noqa: ANN401
        super().__init__(reward_fn, **options)
        if k < 1 or not float(k).is_integer():
            raise ValueError(f"k must be an integer of at least 1, got {k}")
        if RANDOM in self._mixture.weights or DESIRED in self._mixture.weights:
            raise ValueError(
                "HindsightAugment sees one episode at a time and cannot draw "
                f"{self.strategy!r} goals: use HindsightRelabel"
            )
        self.k = int(k)
        # Batches of unfinished episodes. The first one has the oldest transition.
        self._unfinished: list[TensorDictBase] = []

    def _inv_call(  # type: ignore[override]  # buffers accept None
        self, tensordict: TensorDictBase
    ) -> TensorDictBase | None:
        """Holds back new transitions, and returns the rows to store.

        The rows are all transitions of the episodes that have ended, and then their
        copies. If no episode has ended, the result is None.
        """
        buffer, method = find_buffer()
        if method == "add" or not tensordict.ndim:
            raise ValueError(
                "HindsightAugment returns several rows for each transition, but `add` "
                "stores one: use `extend`"
            )
        ndim = 1 if buffer is None else buffer.storage.ndim
        if ndim > 1 or samples_slices(buffer):
            raise RuntimeError(
                "HindsightAugment stores single rows: it needs a storage of ndim=1 and "
                "a sampler that does not sample slices; for slices use "
                'HindsightRelabel(unit="slice")'
            )
        mask = self._find_mask(tensordict)
        batch = tensordict if mask is None else tensordict[mask]
        if not batch.shape.numel():
            return None
        with self._lock:
            self._claim(buffer)
            ended = self._take_ended(batch)  # type: ignore[arg-type]  # a TensorDict
            if ended is None:
                return None
            copies = ended.repeat_interleave(self.k, dim=0)
            serials = copies.get(SERIAL_KEY).numpy(force=True)
            drawn = self._memory.draw(serials, self._mixture, self._generator)
        device = copies.get(SERIAL_KEY).device
        goals = torch.from_numpy(drawn).to(device)
        rows = torch.arange(len(copies), device=device)
        self._rewriter.rewrite(copies, rows, goals)
        return TensorDict.cat([ended, copies]).exclude(SERIAL_KEY)

    def _take_ended(self, batch: TensorDictBase) -> TensorDictBase | None:
        """Adds a batch, and returns the transitions of all ended episodes.

        They are in order of time. If no episode has ended, the result is None. The
        transitions of unfinished episodes stay in `_unfinished` for a later call.
        """
        # The memory must keep the goals of the oldest transition that is still held
        # back, and of all later ones.
        num_remembered = 0
        if self._unfinished:
            oldest = int(self._unfinished[0].get(SERIAL_KEY).min())
            num_remembered = self._memory.count - oldest
        batch = self._remember(batch, num_remembered)
        # Copy the batch, because the caller may change it before the episode ends.
        self._unfinished.append(batch.reshape(-1).to_tensordict())
        serials = [rows.get(SERIAL_KEY).numpy(force=True) for rows in self._unfinished]
        is_unfinished = torch.from_numpy(self._memory.is_open(np.concatenate(serials)))
        if is_unfinished.all():
            return None
        transitions = TensorDict.cat(self._unfinished)
        self._unfinished = [transitions[is_unfinished]] if is_unfinished.any() else []
        ended = transitions[~is_unfinished]
        return ended[ended.get(SERIAL_KEY).argsort()]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns sampled transitions unchanged."""
        return tensordict

    def _forget(self) -> None:
        super()._forget()
        self._unfinished = []

    def get_extra_state(self) -> dict[str, Any]:
        """Returns the memory, the generator, and the transitions that are held back."""
        held = TensorDict.cat(self._unfinished).to_dict() if self._unfinished else None
        return {**super().get_extra_state(), "held": held}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restores the state that `get_extra_state` returned."""
        super().set_extra_state(state)
        held = state["held"]
        self._unfinished = [TensorDict(held, [len(held[SERIAL_KEY])])] if held else []
