"""The goals of the transitions that a buffer holds."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch
from torch import Generator

from torch_panda.transforms import strategies
from torch_panda.transforms.strategies import Strategy, Weights
from torch_panda.transforms.trajectories import Columns, Goals, Integers
from torch_panda.transforms.trajectories import TrajectoryTracker as Tracker

PAGE_BITS = 4
PAGE = 1 << PAGE_BITS  # places


class GoalMemory:
    """Finds the goal achieved at any stored step of a transition's trajectory.

    Transitions are numbered in the order of writing: their serials. A round-robin
    buffer overwrites its oldest rows, so it holds the last serials, and with a
    transition all that lies ahead of it. A ring holds the goals: the transition
    `serial` is its row `serial % rows`.

    Rows of one trajectory are listed, in order of time, in a region of `_rows` that is
    a power of two pages long. A full one moves to a larger region, the old one is used
    again. So to append to many lists or draw from many takes a few calls of numpy, and
    nothing for each row. A trajectory is named by the first page of its region.
    """

    def __init__(self, keeps_desired: bool = False) -> None:
        self._kinds = 2 if keeps_desired else 1
        self.tracker = Tracker()
        self.freed = 0  # serial of the oldest transition that is remembered
        self._goals: Goals = np.zeros((self._kinds, 0))  # (kinds, rows, *goal)
        self._places = np.zeros(0, dtype=np.int32)  # in `_rows`, of the ring's rows
        self._rows = np.zeros(64 * PAGE, dtype=np.int32)  # the ring's, at places
        # Of pages: their trajectory and, if that is the page itself, places of its
        # first transition and behind its last one, and the size of its region.
        self._pages = np.zeros((4, 64), dtype=np.int32)
        self._begun = 0  # trajectories so far
        self._used = 0  # pages that were ever part of a region
        self._free_regions: dict[int, list[int]] = {}  # size -> first pages

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
        head, achieved = self.tracker.count, columns[2]
        self._make_room(head, achieved, stored, capacity)
        runs = self.tracker.follow(*columns, self._last_achieved)
        serial = np.arange(head, head + len(achieved))
        row = serial % len(self._places)
        for kind, goals in enumerate((achieved, desired)[: self._kinds]):
            self._goals[kind][row] = goals
        self._append(runs.trajectory, runs.length, row[runs.order])
        self.tracker.keep(runs)
        return serial

    def _append(self, trajectory: Integers, length: Integers, rows: Integers) -> None:
        """Appends rows, (n,), to trajectories, (m,), `length` of them to each.

        Those that are new, -1, or move get another name, in `trajectory` itself.
        """
        _, _, end, size = self._pages
        full = end[trajectory] + length > trajectory * PAGE + size[trajectory]
        is_new = trajectory < 0
        self._begun += int(is_new.sum())
        for i in (full | is_new).nonzero()[0].tolist():
            trajectory[i] = self._move(int(trajectory[i]), int(length[i]))
        end = self._pages[2]
        places = (end[trajectory] + length - length.cumsum()).repeat(length)
        places += np.arange(len(rows))
        self._rows[places], self._places[rows] = rows, places
        end[trajectory] += length

    def _move(self, trajectory: int, number: int) -> int:
        """Moves a trajectory, if not -1, to where a number more fit: its new name."""
        if trajectory < 0:
            rows = self._rows[:0]
            number = max(number, self.tracker.count // self._begun)  # the mean length
        else:
            _, first, end, _ = self._pages[:, trajectory]
            rows = self._rows[first:end].copy()
            self._release(trajectory)
            number = 3 * (len(rows) + number) // 2  # moves become ever rarer
        size = 1 << max(number - 1, PAGE - 1).bit_length()
        free = self._free_regions.setdefault(size, [])
        if not free:
            free.append(self._used)
            self._used += size // PAGE
            if (more := self._used - self._pages.shape[1]) > 0:
                more = max(more, self._pages.shape[1])
                self._pages = np.pad(self._pages, ((0, 0), (0, more)))
                self._rows = np.pad(self._rows, (0, more * PAGE))
        new = free.pop()
        self._pages[0, new : new + size // PAGE] = new
        start, end = new * PAGE, new * PAGE + len(rows)
        self._pages[1:, new] = start, end, size
        self._rows[start:end], self._places[rows] = rows, np.arange(start, end)
        return new

    def _release(self, trajectory: int) -> None:
        """Lets the region of a trajectory be used again."""
        self._free_regions[int(self._pages[3, trajectory])].append(trajectory)

    def _last_achieved(self, trajectory: Integers) -> Goals:
        """Returns what the last transitions of trajectories achieved, (m, *goal)."""
        row = self._rows.take(self._pages[2].take(trajectory) - 1)
        return self._goals[0].take(row, axis=0)

    def _make_room(
        self, head: int, goals: Goals, stored: int, capacity: int | None
    ) -> None:
        """Makes the ring hold some more; the first goals tell their type."""
        rows, end = len(self._places), head + len(goals)
        if end - self.freed > rows:
            self.free(head - stored)
        if end - self.freed <= rows:
            return
        room = max(1024, 2 * rows)
        if capacity is not None:  # and a little more, so that freeing is rare
            room = min(room, capacity + max(256, capacity // 64))
        room = max(end - self.freed, room)
        larger = np.zeros((self._kinds, room, *goals.shape[1:]), goals.dtype)
        places = np.zeros(room, dtype=np.int32)
        if rows:
            larger = larger.astype(self._goals.dtype)
            serial = np.arange(self.freed, head)
            old, new = serial % rows, serial % room
            larger[:, new], places[new] = self._goals[:, old], self._places[old]
            self._rows[places[new]] = new
        self._goals, self._places = larger, places

    def free(self, floor: int) -> None:
        """Forgets the transitions below a serial: they have been overwritten."""
        if floor <= self.freed:
            return
        places = self._places[np.arange(self.freed, floor) % len(self._places)]
        owner, first, end, _ = self._pages
        trajectory = owner[places >> PAGE_BITS]
        first[trajectory] = places + 1  # of one's several places the last one stays
        gone = set(trajectory[first[trajectory] == end[trajectory]].tolist())
        for t in gone:
            self._release(t)
        self.tracker.forget(gone)
        self.freed = floor

    def find(self, serial: Integers) -> tuple[Integers, Integers]:
        """Returns trajectories of transitions, (n,), and numbers that count steps."""
        place = self._places.take(serial % len(self._places))
        return self._pages[0].take(place >> PAGE_BITS), place

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
            end = np.full(len(serial), self.tracker.count)
            drawn = strategies.draw_integers(self.freed, end, rng)
            return drawn % len(self._places)
        trajectory, place = self.find(serial)
        first, end = self._pages[1:3].take(trajectory, axis=1)
        chosen = strategies.choose_steps(strategy, place, first, end, rng)
        return self._rows.take(chosen)

    def state(self) -> dict[str, Any]:
        """Returns a copy of everything, as tensors, numbers, lists and dicts."""
        state = {**vars(self), "tracker": vars(self.tracker)}
        for name, value in state.items():
            if isinstance(value, np.ndarray):
                state[name] = torch.from_numpy(value)
        return copy.deepcopy(state)

    def load(self, state: dict[str, Any]) -> None:
        """Takes the state that another memory returned."""
        state = copy.deepcopy(state)
        self.tracker.load(state.pop("tracker"))
        for name, value in state.items():
            is_array = isinstance(value, torch.Tensor)
            setattr(self, name, value.numpy() if is_array else value)
