"""The goals of the transitions that a buffer holds."""

import copy
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator

from torch_panda.transforms import strategies
from torch_panda.transforms.strategies import Integers, Strategy, Weights

Goals = NDArray[Any]  # (n, *goal)


class GoalMemory:
    """Finds the goal achieved at any stored step of a transition's trajectory.

    Transitions are numbered in the order of writing: their serials. A round-robin
    buffer overwrites its oldest rows, so it holds the last serials, and with a
    transition all that lies ahead of it. A ring holds the goals: the transition
    `serial` is its row `serial % rows`. Rows of one trajectory are listed, in order of
    time, in a region of `_rows` that is a power of two long. A full one moves to a
    larger region, and the old one is used again.

    A transition goes on with the trajectory of the one of its id before it, unless that
    was done, or got to another goal than this one begins with (as ids begin anew with
    every collector). If none ever begins where the one before got to, ids decide.
    """

    def __init__(self, keeps_desired: bool) -> None:
        self._kinds = 2 if keeps_desired else 1
        self.count = 0  # transitions so far: serial of the next one
        self.freed = 0  # serial of the oldest transition that is remembered
        self.open: dict[int, int] = {}  # id -> last serial of what may go on
        self._has_roots = False
        self._links = False  # whether one ever began with the goal before it
        self._goals: Goals = np.zeros((self._kinds, 0))  # (kinds, rows, *goal)
        self._index = np.zeros((2, 0), dtype=np.int32)  # trajectories, steps
        # Of trajectories: their first step, the end, where in `_rows` step 0 would be,
        # up to which step there is room, and where in `_rows` their region begins.
        self._table = np.zeros((5, 64), dtype=np.int32)
        self._unused = [*range(64)]  # numbers of no trajectory that is remembered
        self._rows = np.zeros(1024, dtype=np.int32)  # of the ring
        self._used = 0  # places that were ever part of a region
        self._free_regions: dict[int, list[int]] = {}  # size -> where they begin

    def write(
        self,
        ids: Integers,
        done: NDArray[np.bool_],
        goals: tuple[Goals | None, Goals, Goals],
        stored: int,
        capacity: int | None,
    ) -> Integers:
        """Takes transitions that are about to be stored; returns their serials, (n,).

        Args:
            ids: of their trajectories, or environments, (n,).
            done: whether these end, (n,).
            goals: that had been achieved before them, if known; that they achieved; and
                that they were asked for, (n, *goal) each.
            stored: how many transitions before them are still stored.
            capacity: how many can be stored, if that is known.
        """
        root, achieved, _ = goals
        self._make_room(achieved, stored, capacity)
        serial = np.arange(self.count, self.count + len(ids))
        row = serial % self._index.shape[1]
        for kind in range(self._kinds):
            self._goals[kind, row] = goals[1 + kind]
        before = self._follow(ids, done, root, serial)
        placed: dict[int, list[int]] = {}  # row -> trajectory and step
        known = self._index[:, before].T.tolist()
        for i, b, last in zip(row.tolist(), before.tolist(), known, strict=True):
            t, s = placed.get(b, last) if b >= 0 else (self._begin(), -1)
            placed[i] = [t, s + 1]
        self._index[:, row] = trajectory, step = np.array([*placed.values()]).T
        _, end, _, room, _ = self._table
        end[trajectory] = step + 1  # of one's several steps the last one stays
        for t in set(trajectory[step >= room[trajectory]].tolist()):
            self._move(t)
        self._rows[self._table[2, trajectory] + step] = row
        self.count += len(ids)
        return serial

    def _follow(
        self, ids: Integers, done: Goals, root: Goals | None, serial: Integers
    ) -> Integers:
        """Returns the rows of the transitions before, (n,); -1 where one begins."""
        if self._has_roots != (root is not None):
            self.open.clear()
            self._has_roots = root is not None
        previous = []
        rows = zip(ids.tolist(), serial.tolist(), done.tolist(), strict=True)
        for name, own, ends in rows:
            previous.append(self.open.pop(name, -1))
            if not ends:
                self.open[name] = own
        before = np.array(previous)
        begins = before < 0
        before %= self._index.shape[1]
        if root is not None:
            same = self._goals[0].take(before, axis=0) == root
            follows = same.reshape(len(ids), -1).all(1) & ~begins
            self._links = self._links or bool(follows.any())
            begins = ~follows if self._links else begins
        before[begins] = -1
        return before

    def _begin(self) -> int:
        """Returns the number of a new trajectory."""
        if not self._unused:
            number = self._table.shape[1]
            self._table = np.pad(self._table, ((0, 0), (0, number)))
            self._unused = [*range(number, 2 * number)]
        return self._unused.pop()

    def _move(self, trajectory: int) -> None:
        """Moves a trajectory to where its steps fit, and some more."""
        first, end, base, room, _ = self._table[:, trajectory].tolist()
        rows = self._rows[base + first : base + room].copy()
        self._release(trajectory)
        size = 1 << max(15, 9 * (end - first) // 8).bit_length()
        free = self._free_regions.setdefault(size, [])
        if not free:
            free.append(self._used)
            self._used += size
            if (more := self._used - len(self._rows)) > 0:
                self._rows = np.pad(self._rows, (0, max(more, len(self._rows))))
        start = free.pop()
        self._rows[start : start + len(rows)] = rows
        self._table[2:, trajectory] = start - first, first + size, start

    def _release(self, trajectory: int) -> None:
        """Lets the region of a trajectory, if it has one, be used again."""
        base, room, start = self._table[2:, trajectory].tolist()
        if room:
            self._free_regions[base + room - start].append(start)

    def _make_room(self, goals: Goals, stored: int, capacity: int | None) -> None:
        """Makes the ring hold some more; the first goals tell their type."""
        rows, end = self._index.shape[1], self.count + len(goals)
        if end - self.freed > rows:
            self.free(self.count - stored)
        if end - self.freed <= rows:
            return
        room = max(1024, 2 * rows)
        if capacity is not None:  # and a little more, so that freeing is rare
            room = min(room, capacity + max(256, capacity // 64))
        room = max(end - self.freed, room)
        dtype = self._goals.dtype if rows else goals.dtype
        larger = np.zeros((self._kinds, room, *goals.shape[1:]), dtype)
        index = np.zeros((2, room), dtype=np.int32)
        if rows:
            serial = np.arange(self.freed, self.count)
            old, new = serial % rows, serial % room
            larger[:, new], index[:, new] = self._goals[:, old], self._index[:, old]
            trajectory, step = index[:, new]
            self._rows[self._table[2, trajectory] + step] = new
        self._goals, self._index = larger, index

    def free(self, floor: int) -> None:
        """Forgets the transitions below a serial: they have been overwritten."""
        if floor <= self.freed:
            return
        trajectory, step = self.find(np.arange(self.freed, floor))
        first, end = self._table[:2]
        first[trajectory] = step + 1
        for t in set(trajectory[first[trajectory] == end[trajectory]].tolist()):
            self._release(t)
            self._table[:, t] = 0
            self._unused.append(t)
        self.open = {i: last for i, last in self.open.items() if last >= floor}
        self.freed = floor

    def find(self, serial: Integers) -> Integers:
        """Returns trajectories and steps of transitions, (2, n)."""
        return self._index.take(serial % self._index.shape[1], axis=1)

    def is_open(self, serial: Integers) -> Any:  # noqa: ANN401 (booleans)
        """Tells which transitions' trajectories may go on, (n,)."""
        last = np.array([*self.open.values()], dtype=np.int64)
        return np.isin(self.find(serial)[0], self.find(last)[0])

    def draw(self, serial: Integers, weights: Weights, rng: Generator | None) -> Goals:
        """Draws a goal for each serial, (n,), by strategies: (n, *goal)."""
        if len(weights) == 1:
            (strategy,) = weights
            kind = int(strategy == strategies.DESIRED)
            return self._goals[kind].take(self._draw(serial, strategy, rng), axis=0)
        limits = np.cumsum([*weights.values()])[:-1]
        u = strategies.draw_uniform(len(serial), rng)
        which = limits.searchsorted(u, side="right")
        goals = np.empty((len(serial), *self._goals.shape[2:]), self._goals.dtype)
        for number, strategy in enumerate(weights):
            rows = (which == number).nonzero()[0]
            goals[rows] = self.draw(serial[rows], {strategy: 1.0}, rng)
        return goals

    def _draw(
        self, serial: Integers, strategy: str | Strategy, rng: Generator | None
    ) -> Integers:
        """Draws the ring's rows of the transitions that goals are from, (n,)."""
        if strategy in (strategies.RANDOM, strategies.DESIRED):
            end = np.full(len(serial), self.count)
            drawn = strategies.draw_integers(self.freed, end, rng)
            return drawn % self._index.shape[1]
        trajectory, step = self.find(serial)
        first, end, base = self._table[:3].take(trajectory, axis=1)
        chosen = strategies.choose_steps(strategy, step, first, end, rng)
        return self._rows.take(base + chosen)

    def state(self) -> dict[str, Any]:
        """Returns a copy of everything, as tensors, numbers, lists and dicts."""
        own, array = vars(self).items(), np.ndarray
        state = {k: torch.from_numpy(v) if isinstance(v, array) else v for k, v in own}
        return copy.deepcopy(state)

    def load(self, state: dict[str, Any]) -> None:
        """Takes the state that another memory returned."""
        for name, value in copy.deepcopy(state).items():
            is_array = isinstance(value, torch.Tensor)
            setattr(self, name, value.numpy() if is_array else value)
        if not self._links:  # nothing would show that an id is used again
            self.open.clear()
