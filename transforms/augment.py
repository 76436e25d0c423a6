"""Hindsight goals at write time, as a transform of a replay buffer."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from torch_panda.transforms.base import SERIAL_KEY, BufferTransform, samples_slices
from torch_panda.transforms.rewrite import GoalFunction
from torch_panda.transforms.strategies import DESIRED, RANDOM


class HindsightAugment(BufferTransform):
    """Stores every transition once more for each of k goals achieved in its episode.

    The paper's own way (Andrychowicz et al. 2017, arXiv 1707.01495, algorithm 1). An
    episode is held back until it ends; then `extend` stores its transitions and k
    relabelled copies of each, flat, under the same trajectory id.

    Args:
        reward_fn: see `BufferTransform`; called once an `extend`.
        k: number of relabelled copies of a transition.
        **options: see `BufferTransform`; no strategy of other episodes.
    """

    def __init__(self, reward_fn: GoalFunction, *, k: int = 4, **options: Any) -> None:  # noqa: ANN401
        super().__init__(reward_fn, **options)
        if k < 1 or not float(k).is_integer():
            raise ValueError(f"k must be an integer of at least 1, got {k}.")
        if RANDOM in self._weights or DESIRED in self._weights:
            goals = f"cannot draw {self.strategy!r} goals; HindsightRelabel can"
            raise ValueError(f"HindsightAugment sees one episode at a time: {goals}.")
        self.k = k
        self._held: list[TensorDictBase] = []  # of open trajectories, in order

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase | None:
        """Takes transitions in and returns those of the episodes that have ended."""
        buffer = self._find_buffer()
        if not tensordict.ndim:
            raise ValueError("`add` takes many rows for one item: use `extend`.")
        if samples_slices(buffer) or (buffer is not None and buffer.storage.ndim > 1):
            raise RuntimeError(
                "HindsightAugment stores rows one by one: use ndim=1, and "
                'no slices but HindsightRelabel(unit="slice").'
            )
        self._rewriter.check(tensordict)
        stored = self._memory.tracker.count
        stored -= int(self._held[0].get(SERIAL_KEY)[0]) if self._held else stored
        self._held.append(self._note(tensordict, stored, None).reshape(-1))
        held = TensorDict.cat(self._held)
        held = held[held.get(SERIAL_KEY).argsort()]  # in order of time
        trajectory, *_ = self._memory.find(held.get(SERIAL_KEY).cpu().numpy())
        still_open = [*self._memory.tracker.open.values()]
        is_open = torch.from_numpy(np.isin(trajectory, still_open))
        self._held = [held[is_open]] if is_open.any() else []
        return None if is_open.all() else self._augment(held[~is_open])

    def _augment(self, original: TensorDictBase) -> TensorDictBase:
        """Returns transitions of whole episodes, then k relabelled copies of each."""
        tag = original.get(SERIAL_KEY)
        serial = tag.cpu().numpy().repeat(self.k)
        drawn = self._memory.draw(serial, self._weights, 0, self._generator)
        goals = torch.from_numpy(drawn).to(tag.device)
        rows = torch.arange(len(original), device="cpu").repeat_interleave(self.k)
        every = torch.arange(len(rows), device=goals.device)
        copies = self._rewriter.rewrite(original[rows], every, goals)
        return TensorDict.cat([original, copies]).exclude(SERIAL_KEY)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Leaves what is sampled as it is."""
        return tensordict

    def empty(self) -> None:
        """Drops the episodes held back, which the buffer's own `empty` does not."""
        super().empty()
        self._held = []

    def get_extra_state(self) -> dict[str, Any]:
        """Returns the episodes held back and the generator, for `state_dict`."""
        held = [part.to_dict() for part in self._held]
        return {**super().get_extra_state(), "held": held}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Takes what `get_extra_state` returned."""
        super().set_extra_state(state)
        self._held = [TensorDict(p, [len(p[SERIAL_KEY])]) for p in state["held"]]
