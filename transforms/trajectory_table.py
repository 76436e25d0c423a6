"""Where the transitions of every trajectory are, without a Python object for each."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from torch_panda.transforms.trajectories import Integers

PAGE_BITS = 3
PAGE = 1 << PAGE_BITS  # places; the smallest region


class TrajectoryTable:
    """Lists the transitions of trajectories, in order of time, in one array.

    A transition is a row of the caller's ring; a trajectory is a slot, a small number
    that is given to another one once all of it is overwritten. The list of a slot fills
    a region of a power of two places, and moves to a larger one when it is full, so
    that appending to many and drawing from many are a few operations of numpy.

    Attributes:
        rows: (places,), the ring's row of the transition at a place.
        places: (ring's rows,), the other way round.
        first, end: (slots,), the places of a slot's transitions, up to without `end`.
    """

    def __init__(self) -> None:
        self.rows: Integers = np.zeros(0, dtype=np.int32)
        self.places: Integers = np.zeros(0, dtype=np.int32)
        self.first: Integers = np.zeros(0, dtype=np.int64)
        self.end: Integers = np.zeros(0, dtype=np.int64)
        self._limit: Integers = np.zeros(0, dtype=np.int64)  # of the regions, (slots,)
        self._size: Integers = np.zeros(0, dtype=np.int64)
        self._owner: Integers = np.zeros(0, dtype=np.int32)  # slots, (pages,)
        self._used = 0  # places that were ever part of a region
        self._free_regions: dict[int, list[int]] = {}  # size -> first places
        self._free_slots: list[int] = []

    def slot_at(self, place: Integers) -> Integers:
        """Returns whose transitions are at places, (n,)."""
        return self._owner.take(place >> PAGE_BITS)

    def append(self, slots: Integers, lengths: Integers, rows: Integers) -> None:
        """Appends `lengths`, (m,), of the rows, (n,), to the lists of slots, (m,).

        A slot that is -1 is replaced, in `slots` itself, by a new one.
        """
        for i in (slots < 0).nonzero()[0].tolist():
            slots[i] = self._new_slot()
            self._give_region(slots[i], int(lengths[i]))
        too_long = self.end[slots] + lengths > self._limit[slots]
        for i in too_long.nonzero()[0].tolist():
            self._move(slots[i], int(lengths[i]))
        place = (self.end[slots] + lengths - lengths.cumsum()).repeat(lengths)
        place += np.arange(len(rows))
        self.rows[place] = rows
        self.places[rows] = place
        self.end[slots] += lengths

    def overwrite(self, rows: Integers) -> set[int]:
        """Takes out the oldest rows, in order; returns the slots that became free."""
        place = self.places[rows]
        slots = self.slot_at(place)
        self.first[slots] = place + 1  # of a slot's several places the last one stays
        gone = set(slots[self.first[slots] == self.end[slots]].tolist())
        for slot in gone:
            self._free_region(slot)
        self._free_slots += gone
        return gone

    def resize_ring(self, old: Integers, new: Integers, room: int) -> None:
        """Follows transitions from old rows to new ones, (n,), of a larger ring."""
        places = np.zeros(room, dtype=np.int32)
        places[new] = self.places[old]
        self.rows[places[new]] = new
        self.places = places

    def _new_slot(self) -> int:
        if not self._free_slots:
            count = len(self.end)
            more = max(64, count)
            for name in ("first", "end", "_limit", "_size"):
                setattr(self, name, np.pad(getattr(self, name), (0, more)))
            self._free_slots = [*range(count, count + more)]
        return self._free_slots.pop()

    def _give_region(self, slot: int, number: int) -> None:
        """Gives a slot an empty region for at least a number of places."""
        size = max(PAGE, 1 << (number - 1).bit_length())
        free = self._free_regions.setdefault(size, [])
        if not free:
            free.append(self._used)
            self._used += size
            if self._used > len(self.rows):
                more = max(1024, self._used, 2 * len(self.rows)) - len(self.rows)
                self.rows = np.pad(self.rows, (0, more))
                self._owner = np.pad(self._owner, (0, -(-more // PAGE)))
        base = free.pop()
        self._owner[base // PAGE : (base + size) // PAGE] = slot
        self.first[slot] = self.end[slot] = base
        self._limit[slot], self._size[slot] = base + size, size

    def _free_region(self, slot: int) -> None:
        size = int(self._size[slot])
        self._free_regions[size].append(int(self._limit[slot]) - size)

    def _move(self, slot: int, number: int) -> None:
        """Moves what is left of a slot's list to a region for a number more."""
        rows = self.rows[self.first[slot] : self.end[slot]].copy()
        self._free_region(slot)
        length = len(rows) + number
        self._give_region(slot, length + length // 2)  # moves become ever rarer
        base = int(self.end[slot])
        self.end[slot] += len(rows)
        self.rows[base : base + len(rows)] = rows
        self.places[rows] = np.arange(base, base + len(rows))

    def state(self) -> dict[str, Any]:
        """Returns all attributes, arrays as tensors."""
        return {
            name: torch.from_numpy(value) if isinstance(value, np.ndarray) else value
            for name, value in vars(self).items()
        }

    def load(self, state: dict[str, Any]) -> None:
        """Takes what `state` returned."""
        for name, value in state.items():
            is_tensor = isinstance(value, torch.Tensor)
            setattr(self, name, value.numpy() if is_tensor else value)
