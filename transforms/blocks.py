"""Where the goals of every trajectory are kept."""

from __future__ import annotations

from itertools import accumulate

import numpy as np
import torch
from torch import Tensor

from torch_panda.transforms.trajectories import Integers

# Columns of the table of trajectories. Base is where step 0 would be in the goals
# (negative once it is gone); first and end are the steps held, limit the first step
# without room; open is 1 until the trajectory is known to have ended.
BASE, FIRST, END, LIMIT, OPEN = range(5)


class GoalBlocks:
    """Goals by trajectory and step, for trajectories of any number and length.

    A trajectory's goals lie side by side, by step, in a block of one long tensor. A
    block that is full moves to the tensor's end, with room to grow; when the end is
    reached, the blocks in use are moved together. Both cost O(1) a goal, amortised.

    Attributes:
        rows: number of goals to be held at most; it may be changed.
        table: what is known of every trajectory, (trajectories, 5), int32.
        goals: the goals, (entries, *goal), on the device of the first ones.
    """

    def __init__(self) -> None:
        self.rows = 0
        self.table = np.zeros((0, 5), dtype=np.int32)
        self.goals = torch.zeros(0, device="cpu")
        self._goal_size = 1  # numbers a goal
        self._used = 0  # entries up to the end of the last block
        self._typical = 16  # length of the trajectory that ended last
        self._free: list[int] = []  # unused trajectories

    def start(self, goals: Tensor) -> None:
        """Takes type, shape and device from the first goals, (n, *goal)."""
        self.goals = goals.new_zeros(1, *goals.shape[1:])
        self._goal_size = max(1, self.goals.numel())

    def find(self, trajectory: Integers) -> tuple[Integers, ...]:
        """Returns the table's columns for some trajectories, (n,) each."""
        return tuple(self.table.take(trajectory, 0).T)

    def read(self, entry: Integers) -> Tensor:
        """Returns the goals at some entries, (n, *goal)."""
        return self.goals.index_select(0, self._index(entry))

    def write(self, entry: Integers, goals: Tensor) -> None:
        """Sets the goals at some entries."""
        self.goals.index_copy_(0, self._index(entry), goals)

    def _index(self, entry: Integers) -> Tensor:
        return torch.from_numpy(entry).to(self.goals.device)

    def add(self, length: list[int], ended: list[bool]) -> list[int]:
        """Starts trajectories with room for `length` steps, or more unless `ended`."""
        number = len(length)
        most = min(self._typical, self._spare() // (2 * number))
        room = [
            n if end else max(n, most) for n, end in zip(length, ended, strict=True)
        ]
        if len(self._free) < number:
            old = len(self.table)
            more = max(64, old, number)
            self.table = np.concatenate(
                [self.table, np.zeros_like(self.table, shape=(more, 5))]
            )
            self._free.extend(range(old + more - 1, old - 1, -1))
        if self._used + sum(room) > len(self.goals):
            self.compact(extra=sum(room))
        new = [self._free.pop() for _ in room]
        *bases, self._used = accumulate(room, initial=self._used)
        self.table[new] = [
            (base, 0, 0, size, 1) for base, size in zip(bases, room, strict=True)
        ]
        return new

    def append(
        self, trajectory: Integers, length: Integers
    ) -> tuple[Integers, Integers]:
        """Makes trajectories longer; returns their bases and old ends, (m,) each."""
        base, _, end, limit, _ = self.find(trajectory)
        longer = end + length
        if (longer > limit).any():
            base = self._grow(trajectory, longer)
        self.table[trajectory, END] = longer
        return base, end

    def close(self, trajectory: Integers) -> None:
        """Notes that trajectories have ended."""
        self.table[trajectory, OPEN] = 0
        self._typical = int(self.table[trajectory[-1], END])

    def first_steps(self, trajectory: Integers, step: Integers) -> Integers:
        """Returns every trajectory's first step if some, (n,) each, are left out."""
        first = self.table[:, FIRST].copy()
        # The steps of a trajectory go in order, and the last one written stays.
        first[trajectory] = step + 1
        return first

    def drop(self, trajectory: Integers, step: Integers) -> set[int]:
        """Drops steps, (n,) each, and returns the trajectories that are gone."""
        self.table[:, FIRST] = self.first_steps(trajectory, step)
        gone = trajectory[step + 1 == self.table[trajectory, END]]
        self.table[gone] = 0
        self._free.extend(gone.tolist())
        return set(gone.tolist())

    def compact(
        self,
        trajectory: Integers | None = None,
        room: Integers | None = None,
        extra: int = 0,
    ) -> None:
        """Moves all blocks together; some get room to grow, (m,), `extra` is left."""
        base, first, end, *_ = self.table.T
        held = end - first
        size = held.copy()
        if trajectory is not None:
            size[trajectory] = room
        start = size.cumsum() - size
        self._used = int(size.sum())
        goals = self.read(_ranges(base + first, held))
        entries = max(self.rows + self._spare(), self._used + extra)
        if entries != len(self.goals):
            self.goals = goals.new_zeros(entries, *goals.shape[1:])
        self.write(_ranges(start, held), goals)
        self.table[:, BASE] = start - first
        self.table[:, LIMIT] = first + size

    def _spare(self) -> int:
        """Entries beyond one a row: 3 bytes a row, or a quarter more."""
        spare = 3 * self.rows // (4 * self._goal_size)
        return max(1024, min(self.rows // 4, spare))

    def _grow(self, trajectory: Integers, end: Integers) -> Integers:
        """Makes room for the steps below `end` and returns the bases, (m,) each."""
        base, first, old_end, limit, _ = self.find(trajectory)
        # As much again, or room for a trajectory like the last one; all of it together
        # at most half the entries to spare.
        size = end - first
        most = self._spare() // (2 * len(size))
        room = size + size.clip(self._typical).clip(max=most)
        short = end > limit
        total = int(room[short].sum())
        if self._used + total > len(self.goals):
            self.compact(trajectory, room)
        else:
            moved, held = trajectory[short], (old_end - first)[short]
            start = self._used + room[short].cumsum() - room[short]
            goals = self.read(_ranges((base + first)[short], held))
            self.write(_ranges(start, held), goals)
            self.table[moved, BASE] = start - first[short]
            self.table[moved, LIMIT] = (first + room)[short]
            self._used += total
        return self.table[trajectory, BASE]


def _ranges(start: Integers, length: Integers) -> Integers:
    """Concatenates start..start + length - 1 of every pair, (sum of lengths,)."""
    offset: Integers = np.repeat(start - (length.cumsum() - length), length)
    return offset + np.arange(len(offset))
