"""What was achieved at every step of the trajectories that a buffer holds."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch
from torch import Generator, Tensor

from torch_panda.transforms.blocks import GoalBlocks
from torch_panda.transforms.strategies import (
    LOOKING_AHEAD,
    RANDOM,
    Shares,
    Strategy,
    choose_steps,
    uniform,
)
from torch_panda.transforms.trajectories import Integers, Runs, split_runs

# Transitions that may wait to be sorted into trajectories.
MAX_WAITING = 4096


class GoalMemory:
    """Finds the goal achieved at any stored step of a transition's trajectory in O(1).

    Every transition gets a serial number, in the order of writing. A round-robin
    buffer overwrites its oldest rows, so what is stored are the serials from `floor` to
    `head`. A ring gives the trajectory and the step of each; the goals are in blocks by
    trajectory and step.

    Sorting a batch into trajectories takes the same few dozen array operations whether
    it is small or large. So what is written waits until a draw concerns it, that is
    one of the waiting transitions or a trajectory that is still open. These are in
    numpy, whose operations on small arrays take a third of the time of torch's. The
    goals stay on the device of the first data.

    Nothing tells a transform how much its buffer holds: until `observe` has found it
    out from what is sampled, the ring grows with the data.

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
        self._waiting: list[tuple[Tensor, Tensor, Tensor]] = []
        self._ring = np.zeros((0, 2), dtype=np.int32)  # (rows, [trajectory, step])
        self._blocks = GoalBlocks()
        self._open: dict[int, int] = {}  # stream -> trajectory that may go on

    def nbytes(self) -> int:
        """Returns the bytes of all that is held."""
        blocks = self._blocks
        return self._ring.nbytes + blocks.goals.nbytes + blocks.table.nbytes

    # -- writing ----------------------------------------------------------------------

    def write(self, stream: Tensor, done: Tensor, goals: Tensor, unit: int) -> Tensor:
        """Takes the goals that transitions achieved and returns their serials, (n,).

        Args:
            stream: trajectory or environment of every transition, (n,).
            done: whether the transition ends its trajectory, (n,), bool.
            goals: what it achieved, (n, *goal).
            unit: transitions that the buffer writes at one index.
        """
        self._unit = unit
        # Copies, as collectors reuse their tensors.
        self._waiting.append((stream.clone(), done.clone(), goals.clone()))
        start, self.head = self.head, self.head + len(goals)
        if self.capacity is not None:
            self.floor = max(self.floor, self.head - self.capacity)
        if self.head - self._sorted >= MAX_WAITING:
            self._sort()
        return torch.arange(start, self.head, device=goals.device)

    def _sort(self) -> None:
        """Sorts what waits into trajectories."""
        if not self._waiting:
            return
        streams, dones, parts = zip(*self._waiting, strict=True)
        self._waiting.clear()
        goals = torch.cat(parts)
        self._make_room(goals)
        stream, done = (torch.cat(x).cpu().numpy() for x in (streams, dones))
        runs = split_runs(stream, done)
        trajectory = self._trajectories_of(runs)
        base, begin = self._blocks.append(trajectory, runs.length)
        over = [t for t, end in zip(trajectory, runs.ended, strict=True) if end]
        if over:
            self._blocks.close(over)

        # From one entry a run, (m,), to one a transition sorted by run, (n,).
        run_start = runs.length.cumsum() - runs.length
        step = (begin - run_start).repeat(runs.length) + np.arange(len(goals))
        entry = np.empty_like(step)
        entry[runs.order] = base.repeat(runs.length) + step
        self._blocks.write(entry, goals)
        row = (self._sorted + runs.order) % len(self._ring)
        self._ring[row, 0] = np.repeat(trajectory, runs.length)
        self._ring[row, 1] = step
        self._sorted = self.head

    def _make_room(self, goals: Tensor) -> None:
        """Makes the ring hold what waits; the first goals tell type and device."""
        if not len(self._ring):
            self._blocks.start(goals)
            self._resize(self._ring_length())
        if self.head - self._forgotten > len(self._ring):
            self._forget()
        if self.head - self._forgotten > len(self._ring):
            self._resize(max(self.head - self._forgotten, 2 * len(self._ring)))

    def _ring_length(self) -> int:
        """Rows for what is stored and, so that forgetting is rare, a few more."""
        capacity = self.capacity or 1024
        return capacity + max(256, capacity // 64)

    def _resize(self, rows: int) -> None:
        """Gives the ring another length."""
        serial = np.arange(self._forgotten, self._sorted)
        ring = np.zeros((rows, 2), dtype=np.int32)
        if len(serial):
            ring[serial % rows] = self._ring[serial % len(self._ring)]
        self._ring = ring
        self._blocks.rows = rows

    def _trajectories_of(self, runs: Runs) -> list[int]:
        """Returns the trajectory of every run, a known one or a new, m numbers.

        Runs of one stream follow each other: only the first of them may continue a
        trajectory, and only the last may be continued.
        """
        stream, ended = runs.stream, runs.ended
        trajectory = [self._open.get(name, -1) for name in stream]
        new = [
            i
            for i, number in enumerate(trajectory)
            if number < 0 or (i > 0 and stream[i] == stream[i - 1])
        ]
        if new:
            length = runs.length.tolist()
            numbers = self._blocks.add(
                [length[i] for i in new], [ended[i] for i in new]
            )
            for i, number in zip(new, numbers, strict=True):
                trajectory[i] = self._open[stream[i]] = number
        for name, number, end in zip(stream, trajectory, ended, strict=True):
            if end and self._open[name] == number:
                del self._open[name]
        return trajectory

    def _forget(self) -> None:
        """Cuts the trajectories at the floor: what is below has been overwritten."""
        floor = min(self.floor, self._sorted)
        if self._forgotten >= floor:
            return
        gone = self._blocks.drop(*self._written(self._forgotten, floor))
        self._forgotten = floor
        if gone:
            self._open = {s: t for s, t in self._open.items() if t not in gone}

    def _written(self, start: int, stop: int) -> tuple[Integers, Integers]:
        """Returns trajectory and step of the serials from start up to stop."""
        return self.find(np.arange(start, stop))

    # -- reading ----------------------------------------------------------------------

    def observe(self, serial: Integers, index: Integers) -> int:
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
        lap = serial // self._unit - index
        low, high = int(lap.min()), int(lap.max())
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
            self._blocks.compact()
        elif self.capacity is None:
            # Full or not, what was written after a stored transition is stored.
            return max(self.floor, int(serial.min()))
        elif low > self._origin and (low - self._origin) * self._unit % self.capacity:
            self._origin = low  # emptied
            self.floor = max(self.floor, low * self._unit)
        return self.floor

    def find(self, serial: Integers) -> tuple[Integers, Integers]:
        """Returns trajectory and step of transitions not below the floor, (n,) each."""
        if self._waiting and serial.max(initial=-1) >= self._sorted:
            self._sort()
        trajectory, step = self._ring.take(serial % len(self._ring), 0).T
        return trajectory, step

    def draw(
        self,
        serial: Integers,
        strategy: str | Strategy,
        share: Shares,
        floor: int,
        generator: Generator | None,
    ) -> Tensor:
        """Draws a goal for each of some stored transitions, (n, *goal).

        Args:
            serial: serials of the transitions, (n,).
            strategy: chooses the step; "random" draws from all stored transitions.
            share: random numbers from 0 to 1, (n,).
            floor: serial of the oldest transition that goals may come from; strategies
                that look ahead need none.
            generator: source of randomness for a user's own strategy.
        """
        blocks = self._blocks
        if strategy == RANDOM:
            trajectory, goal_step = self.find(uniform(floor, self.head, share))
            base, *_ = blocks.find(trajectory)
            return blocks.read(base + goal_step)
        trajectory, step = self.find(serial)
        base, first, end, _, is_open = blocks.find(trajectory)
        if self._waiting and is_open.any():
            self._sort()
            base, first, end, *_ = blocks.find(trajectory)
        if strategy not in LOOKING_AHEAD:
            first = blocks.first_steps(*self._written(self._forgotten, floor))
            first = first[trajectory]
        goal_step = choose_steps(strategy, step, first, end, share, generator)
        return blocks.read(base + goal_step)

    # -- saving -----------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Returns a copy of everything, as tensors, numbers, lists and dicts."""
        self._sort()
        own = {k: v for k, v in vars(self).items() if k != "_blocks"}
        own["_ring"] = torch.from_numpy(self._ring)
        blocks = {**vars(self._blocks), "table": torch.from_numpy(self._blocks.table)}
        return copy.deepcopy({"memory": own, "blocks": blocks})

    def load(self, state: dict[str, Any]) -> None:
        """Takes the state that another memory returned."""
        state = copy.deepcopy(state)
        vars(self).update(state["memory"])
        vars(self._blocks).update(state["blocks"])
        self._ring = state["memory"]["_ring"].numpy()
        self._blocks.table = state["blocks"]["table"].numpy()
