"""The goals of the transitions that a buffer holds."""

from __future__ import annotations

import copy
from array import array
from bisect import bisect_left
from operator import getitem
from typing import Any

import numpy as np
import torch
from torch import Generator

from torch_panda.transforms import strategies
from torch_panda.transforms.strategies import Strategy, Weights
from torch_panda.transforms.trajectories import Columns, Goals, Integers
from torch_panda.transforms.trajectories import TrajectoryTracker as Tracker


class GoalMemory:
    """Finds the goal achieved at any stored step of a transition's trajectory.

    Transitions are numbered in the order of writing. A round-robin buffer overwrites
    its oldest rows, so it holds the last serials, and with a transition what lies ahead
    of it. A ring holds the goals of every serial, and a growing array the serials of a
    trajectory, which is named by its first one, as distances from it.
    """

    def __init__(self, keeps_desired: bool = False) -> None:
        self._kinds = 2 if keeps_desired else 1
        self.tracker = Tracker()
        self.freed = 0  # serial of the oldest transition that is remembered
        self._goals: Goals = np.zeros(0)  # (rows, achieved or desired, *goal)
        self._distance = np.zeros(0, dtype=np.int32)  # from the first serial, (rows,)
        self._steps: dict[int, array[int]] = {}  # trajectory -> distances, ascending

    def write(
        self, columns: Columns, desired: Goals, stored: int, capacity: int | None
    ) -> Integers:
        """Takes the goals of transitions and returns their serials, (n,)."""
        head, achieved = self.tracker.count, columns[2]
        self._make_room(head, achieved, stored, capacity)
        follow = self.tracker.follow
        order, length, trajectory = follow(*columns, self._last_achieved)
        serial = np.arange(head, head + len(order))
        for kind, goals in enumerate((achieved, desired)[: self._kinds]):
            self._goals[serial % len(self._goals), kind] = goals
        distance = head + order - trajectory.repeat(length)
        self._distance[(head + order) % len(self._distance)] = distance
        numbers, ends = distance.tolist(), length.cumsum()
        starts = (ends - length).tolist()
        for t, i, j in zip(trajectory.tolist(), starts, ends.tolist(), strict=True):
            self._steps.setdefault(t, array("i")).extend(numbers[i:j])
        return serial

    def _last_achieved(self, trajectories: Integers) -> Goals:
        last = (self._steps[t][-1] for t in trajectories.tolist())
        return self._read(trajectories + np.fromiter(last, np.int64, len(trajectories)))

    def _make_room(
        self, head: int, goals: Goals, stored: int, capacity: int | None
    ) -> None:
        """Makes the ring hold some more; the first goals tell their type."""
        rows = len(self._distance)
        if not rows:
            self._goals = np.zeros((0, self._kinds, *goals.shape[1:]), goals.dtype)
        end = head + len(goals)
        if end - self.freed > rows:
            self._free(head - stored)
        if end - self.freed <= rows:
            return
        room = max(1024, 2 * rows)
        if capacity is not None:  # and a little more, so that freeing is rare
            room = min(room, capacity + max(256, capacity // 64))
        room = max(end - self.freed, room)
        serial = np.arange(self.freed, head)
        distance = np.zeros(room, dtype=np.int32)
        larger = np.zeros((room, *self._goals.shape[1:]), self._goals.dtype)
        if len(serial):
            old, new = serial % rows, serial % room
            distance[new] = self._distance[old]
            larger[new] = self._goals[old]
        self._goals, self._distance = larger, distance

    def _free(self, floor: int) -> None:
        """Forgets the transitions below a serial: they have been overwritten."""
        gone = set()
        overwritten = self._trajectory_of(np.arange(self.freed, floor))
        for t in np.unique(overwritten).tolist():
            steps = self._steps[t]
            del steps[: bisect_left(steps, floor - t)]
            if not steps:
                del self._steps[t]
                gone.add(t)
        self.freed = max(self.freed, floor)
        if not gone.isdisjoint(self.tracker.open.values()):
            ids = self.tracker.open.items()
            self.tracker.open = {i: t for i, t in ids if t not in gone}

    def _read(self, serial: Integers, kind: int = 0) -> Goals:
        """Returns the achieved (0) or desired (1) goals of serials, (n, *goal)."""
        return self._goals[serial % len(self._goals), kind]

    def _trajectory_of(self, serial: Integers) -> Integers:
        return serial - self._distance[serial % len(self._distance)]

    def find(self, serial: Integers) -> tuple[Integers, Integers, list[array[int]]]:
        """Returns trajectory and step of transitions, (n,), and all their distances."""
        trajectory = self._trajectory_of(serial)
        steps = [*map(self._steps.__getitem__, trajectory.tolist())]
        step = map(bisect_left, steps, (serial - trajectory).tolist())
        return trajectory, np.fromiter(step, np.int64, len(serial)), steps

    def draw(
        self, serial: Integers, weights: Weights, floor: int, rng: Generator | None
    ) -> Goals:
        """Draws a goal for each serial; the oldest that is stored is `floor`."""
        if len(weights) == 1:
            (strategy,) = weights
            source = self._draw(serial, strategy, max(floor, self.freed), rng)
            return self._read(source, kind=int(strategy == strategies.DESIRED))
        limits = np.cumsum([*weights.values()])[:-1]
        which = limits.searchsorted(
            strategies.draw_uniform(len(serial), rng), side="right"
        )
        goals = np.empty((len(serial), *self._goals.shape[2:]), self._goals.dtype)
        for number, strategy in enumerate(weights):
            rows = (which == number).nonzero()[0]
            goals[rows] = self.draw(serial[rows], {strategy: 1.0}, floor, rng)
        return goals

    def _draw(
        self,
        serial: Integers,
        strategy: str | Strategy,
        floor: int,
        rng: Generator | None,
    ) -> Integers:
        """Draws the serials of the transitions that goals are from, (n,)."""
        if strategy in (strategies.RANDOM, strategies.DESIRED):
            return strategies.draw_integers(
                floor, np.full_like(serial, self.tracker.count), rng
            )
        trajectory, step, steps = self.find(serial)
        end = np.fromiter(map(len, steps), np.int64, len(steps))
        first = np.zeros_like(end)
        if strategy not in strategies.LOOKING_AHEAD:
            oldest = map(bisect_left, steps, (floor - trajectory).tolist())
            first = np.minimum(np.fromiter(oldest, np.int64, len(steps)), step)
        chosen = strategies.choose_steps(strategy, step, first, end, rng)
        distance = map(getitem, steps, chosen.tolist())
        return trajectory + np.fromiter(distance, np.int64, len(steps))

    def state(self) -> dict[str, Any]:
        """Returns a copy of everything, as tensors, numbers, lists and dicts."""
        rings = torch.from_numpy(self._goals), torch.from_numpy(self._distance)
        state = {"freed": self.freed, "rings": rings}
        state["steps"] = {t: steps.tolist() for t, steps in self._steps.items()}
        return copy.deepcopy({**state, "tracker": vars(self.tracker)})

    def load(self, state: dict[str, Any]) -> None:
        """Takes the state that another memory returned."""
        state = copy.deepcopy(state)
        self.freed = state["freed"]
        self._goals, self._distance = (ring.numpy() for ring in state["rings"])
        self._steps = {t: array("i", steps) for t, steps in state["steps"].items()}
        self.tracker.load(state["tracker"])
