"""The goals of the transitions that a buffer holds."""

from __future__ import annotations

import copy
from array import array
from itertools import chain
from typing import Any

import numpy as np
import torch
from torch import Generator

from torch_panda.transforms import strategies
from torch_panda.transforms.columns import Columns, Goals, Integers
from torch_panda.transforms.strategies import Strategy, Weights


class GoalMemory:
    """Finds the goal achieved at any stored step of a transition's trajectory.

    Transitions are numbered in the order of writing: their serials. A round-robin
    buffer overwrites its oldest rows, so it holds the last serials, and with a
    transition all that lies ahead of it. A ring holds the goals: the transition
    `serial` is its row `serial % rows`. Every trajectory lists its rows of the ring in
    order of time; a transition's step is its place in that list.

    A transition goes on with the trajectory of the one of its id before it, unless that
    was done, or got to another goal than this one begins with (as ids begin anew with
    every collector). If none ever begins where the one before got to, ids decide.
    """

    def __init__(self, keeps_desired: bool = False) -> None:
        self._kinds = 2 if keeps_desired else 1
        self.count = 0  # transitions so far: serial of the next one
        self.freed = 0  # serial of the oldest transition that is remembered
        self.open: dict[int, int] = {}  # id -> last serial of what may go on
        self._has_roots = False
        self._links = False  # whether one ever began with the goal before it
        self._goals: Goals = np.zeros((self._kinds, 0))  # (kinds, rows, *goal)
        self._index = np.zeros((2, 0), dtype=np.int32)  # trajectories and steps of rows
        self._rows: list[array[int]] = []  # of trajectories
        self._spans = np.zeros((2, 64), dtype=np.int32)  # their first step, and the end
        self._unused: list[int] = []  # numbers of trajectories that were overwritten

    def write(
        self, columns: Columns, desired: Goals, stored: int, capacity: int | None
    ) -> Integers:
        """Takes transitions that are about to be stored; returns their serials, (n,).

        Args:
            columns: their ids, ends and achieved goals; see `Columns`.
            desired: their desired goals, (n, *goal).
            stored: how many transitions before them are still stored.
            capacity: how many can be stored, if that is known.
        """
        ids, done, achieved, root = columns
        self._make_room(achieved, stored, capacity)
        serial = np.arange(self.count, self.count + len(ids))
        row = serial % self._index.shape[1]
        for kind, goals in enumerate((achieved, desired)[: self._kinds]):
            self._goals[kind, row] = goals
        before = self._follow(ids, done, serial, root)
        trajectories, index = self._index
        for i, b in zip(row.tolist(), before.tolist(), strict=True):
            trajectory = self._begin() if b < 0 else trajectories[b]
            rows = self._rows[trajectory]
            trajectories[i], index[i] = trajectory, len(rows)
            rows.append(i)
        self._spans[1, trajectories[row]] = index[row] + 1  # the last one's stays
        self.count += len(ids)
        return serial

    def _follow(
        self, ids: Integers, done: Goals, serial: Integers, root: Goals | None
    ) -> Integers:
        """Returns the rows of the transitions before each, (n,), -1 where one begins.

        `root` are the goals that had been achieved before, if the data tell.
        """
        if self._has_roots != (root is not None):
            self.open.clear()
            self._has_roots = root is not None
        previous = []
        for name, own, ends in zip(
            ids.tolist(), serial.tolist(), done.tolist(), strict=True
        ):
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
        if self._unused:
            return self._unused.pop()
        self._rows.append(array("i"))
        if len(self._rows) > self._spans.shape[1]:
            self._spans = np.pad(self._spans, ((0, 0), (0, len(self._rows))))
        return len(self._rows) - 1

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
            places = zip(*index[:, new].tolist(), new.tolist(), strict=True)
            for trajectory, step, row in places:
                self._rows[trajectory][step] = row
        self._goals, self._index = larger, index

    def free(self, floor: int) -> None:
        """Forgets the transitions below a serial: they have been overwritten."""
        if floor <= self.freed:
            return
        trajectory, step = self.find(np.arange(self.freed, floor))
        first, end = self._spans
        first[trajectory] = step + 1  # of one's several steps the last one stays
        for t in set(trajectory[2 * first[trajectory] > end[trajectory]].tolist()):
            rows, gone = self._rows[t], first[t]
            del rows[:gone]
            self._index[1, rows] -= gone
            self._spans[:, t] -= gone
            if not rows:
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
        first, end = self._spans.take(trajectory, axis=1)
        chosen = strategies.choose_steps(strategy, step, first, end, rng)
        rows, places = (
            self._rows,
            zip(trajectory.tolist(), chosen.tolist(), strict=True),
        )
        return np.array([rows[t][s] for t, s in places], dtype=np.int64)

    def state(self) -> dict[str, Any]:
        """Returns a copy of everything, as tensors, numbers, lists and dicts."""
        state = {**vars(self), "_spans": self._spans[:, : len(self._rows)]}
        state["_rows"] = np.fromiter(chain(*self._rows), dtype=np.int32)
        for name, value in state.items():
            if isinstance(value, np.ndarray):
                state[name] = torch.from_numpy(value)
        return copy.deepcopy(state)

    def load(self, state: dict[str, Any]) -> None:
        """Takes the state that another memory returned."""
        for name, value in copy.deepcopy(state).items():
            is_array = isinstance(value, torch.Tensor)
            setattr(self, name, value.numpy() if is_array else value)
        rows = np.split(np.asarray(self._rows), self._spans[1].cumsum())
        self._rows = [array("i", part.tobytes()) for part in rows[:-1]]
        if not self._links:  # nothing would show that an id is used again
            self.open.clear()
