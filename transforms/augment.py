"""Hindsight goals at write time, as a transform of a replay buffer."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from torch_panda.transforms.base import SERIAL_KEY, BufferTransform, samples_slices
from torch_panda.transforms.rewrite import GoalFunction
from torch_panda.transforms.strategies import DESIRED, RANDOM


class HindsightAugment(BufferTransform):
    """Stores every transition once more for each of k goals achieved in its episode.

    The paper's own way (Andrychowicz et al. 2017, arXiv 1707.01495, algorithm 1): "for
    each stored transition, it stores k identical transitions with a different goal".
    An episode is held back until it ends; then `extend` stores its transitions and k
    relabelled copies of each, k + 1 times the memory of `HindsightRelabel`, which draws
    new goals at every sample instead. What comes out is flat, and the copies keep the
    original's trajectory id, so that trajectories cannot be told apart in the buffer.
    An episode that never ends is never stored; when it ends is told as for
    `HindsightRelabel`.

    Args:
        reward_fn: see `BufferTransform`; called once an `extend`.
        k: number of relabelled copies of a transition.
        **options: see `BufferTransform`. Strategies are those of `HindsightRelabel`,
            but for "random" and "desired", which would need the other episodes.

    Raises:
        ValueError: as for `HindsightRelabel`; the data come from `add`.
        KeyError: the data lack an entry that is needed.
        RuntimeError: as for `HindsightRelabel`; the storage has several dimensions, or
            slices of it are sampled.
    """

    def __init__(
        self,
        reward_fn: GoalFunction,
        *,
        k: int = 4,
        **options: Any,  # noqa: ANN401 (those of the base class)
    ) -> None:
        super().__init__(reward_fn, **options)
        if k < 1 or not float(k).is_integer():
            raise ValueError(f"k must be an integer of at least 1, got {k}.")
        for name in {RANDOM, DESIRED}.intersection(self._weights):
            raise ValueError(
                "HindsightAugment sees one episode at a time and cannot draw "
                f"{name!r} goals; HindsightRelabel can."
            )
        self.k = k
        self._held: list[TensorDictBase] = []  # of open trajectories, in order

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase | None:
        """Takes transitions in and returns those of the episodes that have ended."""
        buffer, method = self._writing_buffer()
        if not tensordict.ndim or method == "add":
            raise ValueError(
                "HindsightAugment stores many transitions at once, which `add` takes "
                "for one item: use `extend`, with data of shape [1] for a single one."
            )
        if samples_slices(buffer) or (buffer and buffer.storage.ndim > 1):
            raise RuntimeError(
                "HindsightAugment stores flat transitions, several goals under one "
                "trajectory id: use a storage with ndim=1 (which [num_envs, time] data "
                "may be extended with) and no slices of it; for slices "
                'HindsightRelabel(unit="slice").'
            )
        oldest = int(self._held[0].get(SERIAL_KEY)[0]) if self._held else None
        head = self._memory.head
        noted = self._note(tensordict, 0 if oldest is None else head - oldest, None)
        self._held.append(noted.reshape(-1))
        held = TensorDict.cat(self._held)
        held = held[held.get(SERIAL_KEY).argsort()]
        trajectory, _ = self._memory.find(held.get(SERIAL_KEY).cpu().numpy())
        still_open = set(self._memory.tracker.open.values())
        is_open = torch.tensor([t in still_open for t in trajectory.tolist()])
        self._held = [held[is_open]] if is_open.any() else []
        return None if is_open.all() else self._augment(held[~is_open])

    def _augment(self, original: TensorDictBase) -> TensorDictBase:
        """Returns transitions of whole episodes, then their k relabelled copies."""
        serial = original.get(SERIAL_KEY).cpu().numpy().repeat(self.k)
        goals = self._memory.draw(serial, self._weights, 0, self._generator)
        copies = original[torch.arange(len(original)).repeat_interleave(self.k)]
        every = torch.arange(len(copies), device=goals.device)
        copies = self._rewriter.rewrite(copies, every, goals)
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

    def __repr__(self) -> str:
        return f"HindsightAugment(k={self.k}, strategy={self.strategy!r})"
