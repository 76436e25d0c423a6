"""What was achieved at every step of the trajectories that a buffer holds."""

from __future__ import annotations

from itertools import accumulate
from typing import Any

import torch
from torch import Generator, Tensor

from .strategies import Strategy, choose_steps, final, future
from .trajectories import Runs, split_runs

# Columns of the table of trajectories.
BASE, FIRST, END, LIMIT, OPEN = range(5)
# Strategies that look ahead only: what follows a stored transition is stored too.
LOOKING_AHEAD = (future, final)
# Transitions that may wait to be sorted into trajectories.
MAX_WAITING = 4096


class GoalMemory:
    """Finds the goal achieved at any stored step of a transition's trajectory in O(1).

    Every transition gets a serial number, in the order of writing. A round-robin buffer
    overwrites its oldest rows, so what is stored are the serials from `floor` to `head`.
    A ring gives the trajectory and the step of each. A trajectory's goals lie side by
    side, by step, in a block of one long tensor. A block that is full moves to the
    tensor's end, with room to grow; when the end is reached, the blocks in use are moved
    together. Both cost O(1) a transition, amortised.

    Sorting a batch into trajectories takes the same few dozen tensor operations whether
    it is small or large. So what is written waits until a draw concerns it, that is
    one of the waiting transitions or a trajectory that is still open.

    Nothing tells a transform how much its buffer holds: until `observe` has found it out
    from what is sampled, the ring grows with the data.

    Args:
        capacity: number of transitions the buffer holds, None if unknown.
    """

    def __init__(self, capacity: int | None = None) -> None:
        self._initial_capacity = capacity
        self.clear()

    def clear(self) -> None:
        """Forgets everything, the sizes and the type of the goals included."""
        self.capacity = self._initial_capacity
        self.head = 0  # serial of the next transition
        self.floor = 0  # serial of the oldest one stored
        self._sorted = 0  # serial of the first transition that waits
        self._forgotten = 0  # floor that trajectories are cut at; lags behind
        self._unit = 1  # transitions written at one index of the storage
        self._origin = 0  # serial, in units, that index 0 is counted from
        self._waiting: list[tuple[Tensor, Tensor, Tensor]] = []  # stream, done, goals
        self._goals = torch.zeros(0)  # (entries, *goal)
        self._goals_end = 0  # first unused entry
        self._ring = torch.zeros(0, 2, dtype=torch.int32)  # (rows, [trajectory, step])
        # Base is where step 0 would be in the goals (negative once it is gone); first
        # and end are the steps stored, limit the first step without room.
        self._table = torch.zeros(0, 5, dtype=torch.int32)
        self._room = 16  # length of the trajectory that ended last
        self._free: list[int] = []  # unused trajectories
        self._open: dict[int, int] = {}  # stream -> trajectory that may go on

    @property
    def device(self) -> torch.device:
        """Where the memory is: the device of the first data written."""
        return self._ring.device

    def nbytes(self) -> int:
        """Returns the bytes of all the tensors held."""
        return self._goals.nbytes + self._ring.nbytes + self._table.nbytes

    # -- writing ----------------------------------------------------------------------

    def write(self, stream: Tensor, done: Tensor, goals: Tensor, unit: int) -> Tensor:
        """Takes the goals that transitions achieved and returns their serials, (n,).

        Args:
            stream: trajectory or environment of every transition, (n,), int64.
            done: whether the transition ends its trajectory, (n,), bool.
            goals: what it achieved, (n, *goal).
            unit: transitions that the buffer writes at one index.
        """
        serial = torch.arange(self.head, self.head + len(goals), device=goals.device)
        self._unit = unit
        # Copies, as collectors reuse their tensors.
        self._waiting.append((stream.long().clone(), done.clone(), goals.clone()))
        self.head += len(goals)
        if self.capacity is not None:
            self.floor = max(self.floor, self.head - self.capacity)
        if self.head - self._sorted >= MAX_WAITING:
            self._sort()
        return serial

    def _sort(self) -> None:
        """Sorts what waits into trajectories."""
        if not self._waiting:
            return
        stream, done, goals = (torch.cat(part) for part in zip(*self._waiting))
        self._waiting.clear()
        self._make_room(goals)
        runs = split_runs(stream, done)
        # One entry a run, (m,).
        trajectory = self._trajectories_of(runs)
        base, _, begin, limit, _ = self._table.index_select(0, trajectory).unbind(1)
        end = begin + runs.length
        if (end > limit).any():
            base = self._grow(trajectory, end)
        self._table[:, END].index_add_(0, trajectory, runs.length)

        # One entry a transition, sorted by run, (n,).
        per_run = torch.stack([trajectory, begin - runs.begin, base], 1)
        trajectory, step, base = per_run.index_select(0, runs.run).unbind(1)
        step = step + torch.arange(len(step), dtype=torch.int32, device=self.device)
        entry = (base + step).long()
        self._goals.index_copy_(0, entry, goals.index_select(0, runs.order))
        row = (self._sorted + runs.order) % len(self._ring)
        self._ring.index_copy_(0, row, torch.stack([trajectory, step], 1))
        self._sorted = self.head

    def _make_room(self, goals: Tensor) -> None:
        """Makes the ring hold what waits; the first goals tell type and device."""
        if not len(self._ring):
            shape = (self._ring_length(), 2)
            self._ring = torch.zeros(shape, dtype=torch.int32, device=goals.device)
            self._goals = goals.new_zeros(1, *goals.shape[1:])
            self._table = self._table.to(goals.device)
        if self.head - self._forgotten > len(self._ring):
            self._forget()
        if self.head - self._forgotten > len(self._ring):
            self._resize(max(self.head - self._forgotten, 2 * len(self._ring)))

    def _ring_length(self) -> int:
        """Rows for what is stored and, so that forgetting is rare, a few more."""
        capacity = self.capacity or 1024
        return capacity + max(256, capacity // 64)

    def _spare(self) -> int:
        """Entries beyond one a row of the ring: 3 bytes a row, or a quarter more."""
        rows, goal_size = len(self._ring), max(1, self._goals[:1].numel())
        return max(1024, min(rows // 4, 3 * rows // (4 * goal_size)))

    def _trajectories_of(self, runs: Runs) -> Tensor:
        """Returns the trajectory of every run, a known one or a new, (m,), int32.

        Runs of one stream follow each other: only the first of them may continue a
        trajectory, and only the last may be continued.
        """
        stream, ended = runs.stream, runs.ended
        known = list(map(self._open.get, stream))
        new = [
            i
            for i, trajectory in enumerate(known)
            if trajectory is None or (i > 0 and stream[i] == stream[i - 1])
        ]
        if new:
            length = runs.length.tolist()
            spare = self._spare() // (2 * len(new))
            room = [
                length[i] if ended[i] else max(length[i], min(self._room, spare))
                for i in new
            ]
            for i, trajectory in zip(new, self._add(room), strict=True):
                known[i] = self._open[stream[i]] = trajectory
        trajectory = torch.tensor(known, dtype=torch.int32, device=self.device)
        over = [i for i, end in enumerate(ended) if end]
        if over:
            for i in over:
                if self._open[stream[i]] == known[i]:
                    del self._open[stream[i]]
            self._table[trajectory[over], OPEN] = 0
            last = over[-1]
            self._room = int(self._table[known[last], END] + runs.length[last])
        return trajectory

    def _add(self, room: list[int]) -> list[int]:
        """Starts a trajectory with a block of each size and returns their numbers."""
        if len(self._free) < len(room):
            old = len(self._table)
            more = max(64, old, len(room))
            self._table = torch.cat([self._table, self._table.new_zeros(more, 5)])
            self._free.extend(range(old + more - 1, old - 1, -1))
        if self._goals_end + sum(room) > len(self._goals):
            self._compact(extra=sum(room))
        new = [self._free.pop() for _ in room]
        ends = list(accumulate(room, initial=self._goals_end))
        rows = [[base, 0, 0, size, 1] for base, size in zip(ends, room, strict=False)]
        self._table[torch.tensor(new)] = self._table.new_tensor(rows)
        self._goals_end = ends[-1]
        return new

    def _grow(self, trajectory: Tensor, end: Tensor) -> Tensor:
        """Makes room for the steps below `end` and returns the bases, (m,) each."""
        _, first, _, limit, _ = self._table.index_select(0, trajectory).unbind(1)
        # As much again, or room for a trajectory like the last one; all of it together
        # at most half the entries to spare.
        size = end - first
        most = self._spare() // (2 * len(size))
        room = size + size.clamp(min=self._room).clamp(max=most)
        short = end > limit
        total = int(room[short].sum())
        if self._goals_end + total > len(self._goals):
            self._compact(trajectory, room)
        else:
            moved, first, room = trajectory[short], first[short], room[short]
            base, _, old_end, *_ = self._table.index_select(0, moved).unbind(1)
            start = self._goals_end + room.cumsum(0, dtype=torch.int32) - room
            held = old_end - first
            self._goals[_ranges(start, held)] = self._goals[_ranges(base + first, held)]
            self._table[moved, BASE] = start - first
            self._table[moved, LIMIT] = first + room
            self._goals_end += total
        return self._table[:, BASE].index_select(0, trajectory)

    def _compact(
        self,
        trajectory: Tensor | None = None,
        room: Tensor | None = None,
        extra: int = 0,
    ) -> None:
        """Moves all blocks together; some get room to grow, (m,), `extra` is left."""
        base, first, end, *_ = self._table.unbind(1)
        held = end - first
        size = held.clone()
        if trajectory is not None:
            size[trajectory] = room
        start = size.cumsum(0, dtype=torch.int32) - size
        self._goals_end = int(size.sum())
        goals = self._goals[_ranges(base + first, held)]
        length = max(len(self._ring) + self._spare(), self._goals_end + extra)
        if length != len(self._goals):
            self._goals = goals.new_zeros(length, *goals.shape[1:])
        self._goals[_ranges(start, held)] = goals
        self._table[:, BASE] = start - first
        self._table[:, LIMIT] = first + size

    def _resize(self, rows: int) -> None:
        """Gives the ring another length."""
        serial = torch.arange(self._forgotten, self._sorted, device=self.device)
        ring = self._ring.new_zeros(rows, 2)
        ring[serial % rows] = self._ring[serial % len(self._ring)]
        self._ring = ring

    def _forget(self) -> None:
        """Cuts the trajectories at the floor: what is below has been overwritten."""
        floor = min(self.floor, self._sorted)
        if self._forgotten >= floor:
            return
        trajectory, step = self._written(self._forgotten, floor)
        self._table[:, FIRST] = self._first_steps(floor)
        self._forgotten = floor
        gone = trajectory[step + 1 == self._table[trajectory, END]]
        if len(gone):
            self._table[gone] = 0
            self._free.extend(gone.tolist())
            unused = set(gone.tolist())
            self._open = {s: t for s, t in self._open.items() if t not in unused}

    def _first_steps(self, floor: int) -> Tensor:
        """Returns the first step of every trajectory that is not below a serial."""
        trajectory, step = self._written(self._forgotten, floor)
        # A trajectory's transitions go in the order they came, one after the other.
        return self._table[:, FIRST].scatter_reduce(
            0, trajectory.long(), step + 1, "amax"
        )

    def _written(self, start: int, stop: int) -> tuple[Tensor, Tensor]:
        """Returns trajectory and step of the serials from start up to stop."""
        serial = torch.arange(start, stop, device=self.device)
        trajectory, step = self._ring[serial % len(self._ring)].unbind(1)
        return trajectory, step

    # -- reading ----------------------------------------------------------------------

    def needs_observing(self, strategy: Strategy | None) -> bool:
        """Whether `observe` has to see a sample before `draw`."""
        return self.capacity is None or strategy not in LOOKING_AHEAD

    def observe(self, serial: Tensor, index: Tensor) -> int:
        """Learns from sampled rows which transitions the buffer still holds.

        Index 0 is written once a lap of the storage, so `serial // unit - index` is
        where a lap began. The rows of one sample are of at most two laps.

        Args:
            serial: serials of the sampled rows, (n,).
            index: where they are along the storage's first dimension, (n,).

        Returns:
            The serial from which on transitions are known to be stored.

        Raises:
            RuntimeError: the rows were not written round-robin along that dimension.
        """
        lap = torch.div(serial, self._unit, rounding_mode="floor") - index
        low, high = (int(x) for x in torch.aminmax(lap))
        if high > low and (high - low) * self._unit != self.capacity:
            laps = ((lap == low) | (lap == high)).all()
            if low < 0 or not laps or int(index.max()) >= high - low:
                raise RuntimeError(
                    "HindsightRelabel cannot follow this buffer: its rows are not "
                    "written one after the other. Use a round-robin writer, write "
                    "with extend() only, [*batch, time] data if the storage has "
                    "several dimensions and flattened data if it has one."
                )
            self._origin = low
            self.capacity = (high - low) * self._unit
            self.floor = max(self.floor, self.head - self.capacity)
            self._sort()
            self._forget()
            self._resize(max(self._ring_length(), self.head - self._forgotten))
        elif self.capacity is None:
            # Full or not, what was written after a stored transition is stored.
            return max(self.floor, int(serial.min()))
        elif low > self._origin and (low - self._origin) * self._unit % self.capacity:
            self._origin = low  # emptied
            self.floor = max(self.floor, low * self._unit)
        return self.floor

    def find(self, serial: Tensor) -> tuple[Tensor, Tensor]:
        """Returns trajectory and step of transitions not below the floor, (n,) each."""
        if self._waiting and int(serial.max()) >= self._sorted:
            self._sort()
        trajectory, step = self._ring.index_select(
            0, serial % len(self._ring)
        ).unbind(1)
        return trajectory, step

    def draw(
        self,
        serial: Tensor,
        strategy: Strategy | None,
        generator: Generator | None,
        floor: int,
    ) -> Tensor:
        """Draws a goal for each of some stored transitions, (n, *goal).

        Args:
            serial: serials of the transitions, (n,).
            strategy: chooses the step; None draws from all stored transitions.
            generator: source of randomness, None for torch's own.
            floor: serial of the oldest transition that goals may come from; strategies
                that look ahead need none.
        """
        if strategy is None:
            share = torch.rand(len(serial), generator=generator, dtype=torch.float64)
            serial = floor + (share.to(self.device) * (self.head - floor)).long()
            trajectory, goal_step = self.find(serial)
            base = self._table[:, BASE].index_select(0, trajectory)
            return self._goals.index_select(0, base + goal_step)
        trajectory, step = self.find(serial)
        base, first, end, _, is_open = self._table.index_select(0, trajectory).unbind(1)
        if self._waiting and is_open.any():
            self._sort()
            base, first, end, *_ = self._table.index_select(0, trajectory).unbind(1)
        if strategy not in LOOKING_AHEAD:
            first = self._first_steps(floor).index_select(0, trajectory)
        goal_step = choose_steps(strategy, step, first, end, generator)
        return self._goals.index_select(0, base + goal_step)

    # -- saving -----------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Returns a copy of everything, as tensors, numbers, lists and dicts."""
        self._sort()
        return {
            name: value if isinstance(value, int | None) else _copy(value)
            for name, value in vars(self).items()
        }

    def load(self, state: dict[str, Any]) -> None:
        """Takes the state that another memory returned."""
        for name, value in state.items():
            setattr(
                self, name, value if isinstance(value, int | None) else _copy(value)
            )


def _copy(value: Tensor | list | dict) -> Tensor | list | dict:
    return value.clone() if isinstance(value, Tensor) else value.copy()


def _ranges(start: Tensor, length: Tensor) -> Tensor:
    """Concatenates start..start + length - 1 of every pair, (sum of lengths,)."""
    offset = torch.repeat_interleave(start - (length.cumsum(0) - length), length)
    return offset + torch.arange(len(offset), device=start.device)
