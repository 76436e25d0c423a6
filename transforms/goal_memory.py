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
from torch_panda.transforms.trajectory_table import TrajectoryTable


class GoalMemory:
    """Finds the goal achieved at any stored step of a transition's trajectory.

    Transitions are numbered in the order of writing: their serials. A round-robin
    buffer overwrites its oldest rows, so it holds the last serials, and with a
    transition all that lies ahead of it. A ring holds the goals: the transition
    `serial` is its row `serial % rows`. A table lists the rows of every trajectory.
    """

    def __init__(self, keeps_desired: bool = False) -> None:
        self._kinds = 2 if keeps_desired else 1
        self.tracker = Tracker()
        self.freed = 0  # serial of the oldest transition that is remembered
        self._goals: Goals = np.zeros((self._kinds, 0))  # (kinds, rows, *goal)
        self._table = TrajectoryTable()

    def write(
        self, columns: Columns, desired: Goals, stored: int, capacity: int | None
    ) -> Integers:
        """Takes transitions that are about to be stored.

        Args:
            columns: their ids, ends and achieved goals; see `Columns`.
            desired: their desired goals, (n, *goal).
            stored: how many transitions before them are still stored.
            capacity: how many can be stored, if that is known.

        Returns:
            Their serials, (n,).
        """
        head, achieved = self.tracker.count, columns[2]
        self._make_room(head, achieved, stored, capacity)
        runs = self.tracker.follow(*columns, self._last_achieved)
        serial = np.arange(head, head + len(achieved))
        row = serial % self._goals.shape[1]
        for kind, goals in enumerate((achieved, desired)[: self._kinds]):
            self._goals[kind][row] = goals
        self._table.append(runs.trajectory, runs.length, row[runs.order])
        self.tracker.keep(runs)
        return serial

    def _last_achieved(self, trajectories: Integers) -> Goals:
        """Returns what the last transitions of trajectories achieved, (m, *goal)."""
        table = self._table
        last = table.rows.take(table.end.take(trajectories) - 1)
        return self._goals[0].take(last, axis=0)

    def _make_room(
        self, head: int, goals: Goals, stored: int, capacity: int | None
    ) -> None:
        """Makes the ring hold some more; the first goals tell their type."""
        rows, end = self._goals.shape[1], head + len(goals)
        if end - self.freed > rows:
            self.free(head - stored)
        if end - self.freed <= rows:
            return
        if not rows:
            self._goals = np.zeros((self._kinds, 0, *goals.shape[1:]), goals.dtype)
        room = max(1024, 2 * rows)
        if capacity is not None:  # and a little more, so that freeing is rare
            room = min(room, capacity + max(256, capacity // 64))
        room = max(end - self.freed, room)
        serial = np.arange(self.freed, head)
        old, new = serial % max(rows, 1), serial % room
        larger = np.zeros((self._kinds, room, *goals.shape[1:]), self._goals.dtype)
        larger[:, new] = self._goals[:, old]
        self._goals = larger
        self._table.resize_ring(old, new, room)

    def free(self, floor: int) -> None:
        """Forgets the transitions below a serial: they have been overwritten."""
        if floor <= self.freed:
            return
        overwritten = np.arange(self.freed, floor) % self._goals.shape[1]
        self.tracker.forget(self._table.overwrite(overwritten))
        self.freed = floor

    def find(self, serial: Integers) -> tuple[Integers, Integers]:
        """Returns trajectories of transitions and their places in the table, (n,)."""
        place = self._table.places.take(serial % self._goals.shape[1])
        return self._table.slot_at(place), place

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
        rows, table = self._goals.shape[1], self._table
        if strategy in (strategies.RANDOM, strategies.DESIRED):
            end = np.full(len(serial), self.tracker.count)
            return strategies.draw_integers(self.freed, end, rng) % rows
        trajectory, place = self.find(serial)
        first, end = table.first.take(trajectory), table.end.take(trajectory)
        return table.rows.take(
            strategies.choose_steps(strategy, place, first, end, rng)
        )

    def state(self) -> dict[str, Any]:
        """Returns a copy of everything, as tensors, numbers, lists and dicts."""
        state = {"freed": self.freed, "goals": torch.from_numpy(self._goals)}
        state |= {"table": self._table.state(), "tracker": vars(self.tracker)}
        return copy.deepcopy(state)

    def load(self, state: dict[str, Any]) -> None:
        """Takes the state that another memory returned."""
        state = copy.deepcopy(state)
        self.freed, self._goals = state["freed"], state["goals"].numpy()
        self._table.load(state["table"])
        self.tracker.load(state["tracker"])
