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
from torch_panda.transforms.trajectories import (
    Integers,
    Runs,
    differ,
    find_strays,
    split_runs,
)

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
        # Arguments of `write`: streams, dones, goals and, if known, roots.
        self._waiting: list[list[Tensor]] = []
        self._rooted = False  # whether they are known
        # Whether a row's root was ever what the row before it achieved.
        self._linked = False
        self._ring = np.zeros((0, 2), dtype=np.int32)  # (rows, [trajectory, step])
        self._blocks = GoalBlocks()
        self._open: dict[int, int] = {}  # stream -> trajectory that may go on

    def nbytes(self) -> int:
        """Returns the bytes of all that is held."""
        blocks = self._blocks
        return self._ring.nbytes + blocks.goals.nbytes + blocks.table.nbytes

    # -- writing ----------------------------------------------------------------------

    def write(
        self,
        stream: Tensor,
        done: Tensor,
        goals: Tensor,
        root: Tensor | None,
        unit: int,
    ) -> Tensor:
        """Takes the goals that transitions achieved and returns their serials, (n,).

        Args:
            stream: trajectory or environment of every transition, (n,).
            done: whether the transition ends its trajectory, (n,), bool.
            goals: what it achieved, (n, *goal).
            root: what was achieved before it, (n, *goal), None if unknown. A stream
                that does not begin there where it was left begins a new trajectory,
                once roots have been seen to be what the row before achieved.
            unit: transitions that the buffer writes at one index.
        """
        self._unit = unit
        if self._rooted != (root is not None):
            self.end_trajectories()
            self._rooted = root is not None
        # Copies, as collectors reuse their tensors.
        self._waiting.append([stream.clone(), done.clone(), goals.clone()])
        if root is not None:
            self._waiting[-1].append(root.clone())
        start, self.head = self.head, self.head + goals.shape[0]
        if self.capacity is not None:
            self.floor = max(self.floor, self.head - self.capacity)
        if self.head - self._sorted >= MAX_WAITING:
            self._sort()
        return torch.arange(start, self.head, device=goals.device)

    def _sort(self) -> None:
        """Sorts what waits into trajectories."""
        if not self._waiting:
            return
        streams, dones, parts, *roots = zip(*self._waiting, strict=True)
        self._waiting.clear()
        goals = _join(parts)
        self._make_room(goals)
        stream, done = (_join(x).cpu().numpy() for x in (streams, dones))
        root = _join(roots[0]) if roots else None
        order = stream.argsort(kind="stable")
        stream, done = stream[order], done[order]
        if root is not None and not self._linked:
            pairs = ((stream[1:] == stream[:-1]) & ~done[:-1]).nonzero()[0]
            strays = find_strays(order, pairs, goals, root)
            self._linked = len(strays) < len(pairs)
        if root is not None and self._linked and len(parts) > 1:
            part = np.arange(len(parts)).repeat([x.shape[0] for x in parts])[order]
            seam = (stream[1:] == stream[:-1]) & (part[1:] != part[:-1])
            done[find_strays(order, seam.nonzero()[0], goals, root)] = True
        runs = split_runs(stream, done)
        trajectory = self._trajectories_of(runs, order[runs.start], root)
        base, begin = self._blocks.append(trajectory, runs.length)
        if runs.ended.any():
            self._blocks.close(trajectory[runs.ended])

        # From one entry a run, (m,), to one a transition sorted by run, (n,).
        step = (begin - runs.start).repeat(runs.length) + np.arange(len(goals))
        entry = np.empty_like(step)
        entry[order] = base.repeat(runs.length) + step
        self._blocks.write(entry, goals)
        row = (self._sorted + order) % len(self._ring)
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

    def _trajectories_of(
        self, runs: Runs, row: Integers, root: Tensor | None
    ) -> Integers:
        """Returns the trajectory of every run, a known one or a new, (m,).

        Runs of one stream follow each other: only the first of them may continue a
        trajectory, and only the last may be continued.

        Args:
            runs: the runs.
            row: the first row of every run, (m,).
            root: what was achieved before every row, (n, *goal), None if unknown.
        """
        trajectory = np.array([self._open.pop(name, -1) for name in runs.stream])
        if root is not None:
            self._end_restarted(trajectory, row, root)
        new = (trajectory < 0).nonzero()[0]
        if len(new):
            trajectory[new] = self._blocks.add(
                runs.length[new].tolist(), runs.ended[new].tolist()
            )
        for name, number, ended in zip(
            runs.stream, trajectory.tolist(), runs.ended.tolist(), strict=True
        ):
            if not ended:
                self._open[name] = number
        return trajectory

    def _end_restarted(self, trajectory: Integers, row: Integers, root: Tensor) -> None:
        """Ends trajectories, (m,), whose run begins elsewhere, and sets them to -1."""
        old = (trajectory >= 0).nonzero()[0]
        base, _, end, *_ = self._blocks.find(trajectory[old])
        last = self._blocks.read(base + end - 1)
        first = root.index_select(0, torch.from_numpy(row[old]).to(root.device))
        over = old[differ(last, first)]
        self._linked = self._linked or len(over) < len(old)
        if self._linked and len(over):
            self._blocks.close(trajectory[over])
            trajectory[over] = -1

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

    def end_trajectories(self) -> None:
        """Ends all trajectories; what is written next begins new ones."""
        self._sort()
        if self._open:
            self._blocks.close(np.array(list(self._open.values())))
            self._open.clear()

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
                    "several dimensions and flattened data if it has one, and put the "
                    "transform into the buffer before the first extend()."
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
        if not self._linked:  # nothing would show that a stream's name is used again
            self.end_trajectories()


def _join(parts: tuple[Tensor, ...]) -> Tensor:
    """Concatenates tensors; a single one, the most frequent case, is not copied."""
    return parts[0] if len(parts) == 1 else torch.cat(parts)
