"""The goals of the transitions that a buffer holds."""

from __future__ import annotations

import sys
from array import array
from bisect import bisect_left
from typing import Any

import numpy as np
import torch
from torch import Generator, Tensor

from torch_panda.transforms.strategies import (
    DESIRED,
    LOOKING_AHEAD,
    RANDOM,
    Strategy,
    Weights,
    choose_steps,
    draw_integers,
    draw_strategies,
)
from torch_panda.transforms.trajectories import Integers, TrajectoryTracker


class GoalMemory:
    """Finds the goal achieved at any stored step of a transition's trajectory.

    Every transition has a serial number, in the order of writing. A round-robin buffer
    overwrites its oldest rows, so it holds the last serials; what lies ahead of a
    stored transition in its trajectory was written later, so it is stored too. A ring
    holds the goals of every serial, and a growing array the serials of a trajectory,
    which is named by its first one; the others are kept as distances from it.

    The goals stay on the device of the first data, the rest is numpy's and Python's:
    their operations on a few hundred numbers take a third of the time of torch's.

    Args:
        keeps_desired: whether also desired goals are kept.
    """

    def __init__(self, keeps_desired: bool = False) -> None:
        self._kinds = 2 if keeps_desired else 1
        self.tracker = TrajectoryTracker()
        self.freed = 0  # serial of the oldest transition that is remembered
        self._goals = torch.zeros(0, device="cpu")  # (rows, achieved or desired, *goal)
        self._distance = np.zeros(0, dtype=np.int32)  # from the first serial, (rows,)
        self._steps: dict[int, array[int]] = {}  # trajectory -> distances, ascending

    @property
    def head(self) -> int:
        """Serial of the next transition."""
        return self.tracker.count

    def nbytes(self) -> int:
        """Returns the bytes of all that is held."""
        trajectories = sum(map(sys.getsizeof, self._steps.values()))
        rings = self._goals.nbytes + self._distance.nbytes
        return rings + sys.getsizeof(self._steps) + trajectories

    def write(
        self,
        ids: Tensor,
        done: Tensor,
        achieved: Tensor,
        root: Tensor | None,
        desired: Tensor,
        *,
        stored: int,
        capacity: int | None,
    ) -> Tensor:
        """Takes the goals of transitions and returns their serials, (n,).

        Args:
            ids: id of every transition's trajectory or environment, (n,).
            done: whether the transition ends its trajectory, (n,), bool.
            achieved: what it achieved, (n, *goal).
            root: what was achieved before it, (n, *goal), None if unknown.
            desired: what was asked for, (n, *goal).
            stored: transitions that the buffer holds so far.
            capacity: transitions that it can hold, None if unknown.

        Raises:
            OverflowError: a trajectory goes on for 2**31 transitions.
        """
        self._make_room(achieved, stored, capacity)
        head = self.head
        runs = self.tracker.follow(ids, done, achieved, root, self._last_achieved)
        serial = torch.arange(head, self.head, device=self._goals.device)
        kinds = [x.to(self._goals) for x in (achieved, desired)[: self._kinds]]
        self._goals.index_copy_(0, serial % len(self._goals), torch.stack(kinds, 1))
        own = head + runs.order
        distance = own - runs.trajectory.repeat(runs.length)
        if distance.max() >= 2**31:
            raise OverflowError("a trajectory must be shorter than 2**31 transitions.")
        self._distance[own % len(self._distance)] = distance
        numbers, ends = distance.tolist(), (runs.start + runs.length).tolist()
        for trajectory, start, end in zip(
            runs.trajectory.tolist(), runs.start.tolist(), ends, strict=True
        ):
            self._steps.setdefault(trajectory, array("i")).extend(numbers[start:end])
        return serial

    def _last_achieved(self, trajectories: list[int]) -> Tensor:
        """Returns what trajectories achieved last, (k, *goal)."""
        return self._read(np.array([t + self._steps[t][-1] for t in trajectories]))

    def _make_room(self, goals: Tensor, stored: int, capacity: int | None) -> None:
        """Makes the ring hold some more; the first goals tell type and device."""
        rows = len(self._distance)
        if not rows:
            self._goals = goals.new_zeros(0, self._kinds, *goals.shape[1:])
        if self.head + len(goals) - self.freed > rows:
            self._free(self.head - stored)
        needed = self.head + len(goals) - self.freed
        if needed <= rows:
            return
        room = max(1024, 2 * rows)
        if capacity is not None:  # and a little more, so that freeing is rare
            room = min(room, capacity + max(256, capacity // 64))
        rows = max(needed, room)
        serial = np.arange(self.freed, self.head)
        distance = np.zeros(rows, dtype=np.int32)
        larger = self._goals.new_zeros(rows, *self._goals.shape[1:])
        if len(serial):
            old = serial % len(self._distance)
            distance[serial % rows] = self._distance[old]
            larger[torch.from_numpy(serial % rows)] = self._goals[torch.from_numpy(old)]
        self._goals, self._distance = larger, distance

    def _free(self, floor: int) -> None:
        """Forgets the transitions below a serial: they have been overwritten."""
        if floor <= self.freed:
            return
        gone = set()
        for trajectory in np.unique(self._trajectory_of(np.arange(self.freed, floor))):
            steps = self._steps[int(trajectory)]
            del steps[: bisect_left(steps, floor - int(trajectory))]
            if not steps:
                del self._steps[int(trajectory)]
                gone.add(int(trajectory))
        self.freed = floor
        still_open = self.tracker.open
        if not gone.isdisjoint(still_open.values()):
            self.tracker.open = {i: t for i, t in still_open.items() if t not in gone}

    # -- reading ----------------------------------------------------------------------

    def _read(self, serial: Integers, kind: int = 0) -> Tensor:
        """Returns the achieved (0) or desired (1) goals of serials, (n, *goal)."""
        rows = torch.from_numpy(serial % len(self._goals)).to(self._goals.device)
        return self._goals[:, kind].index_select(0, rows)

    def _trajectory_of(self, serial: Integers) -> Integers:
        return serial - self._distance[serial % len(self._distance)]

    def find(self, serial: Integers) -> tuple[Integers, Integers]:
        """Returns trajectory and step of remembered transitions, (n,) each."""
        trajectory = self._trajectory_of(serial)
        pairs = zip(serial.tolist(), trajectory.tolist(), strict=True)
        step = [bisect_left(self._steps[t], s - t) for s, t in pairs]
        return trajectory, np.array(step, dtype=np.int64)

    def draw(
        self,
        serial: Integers,
        weights: Weights,
        floor: int,
        generator: Generator | None,
    ) -> Tensor:
        """Draws a goal for each of some remembered transitions, (n, *goal).

        Args:
            serial: serials of the transitions, (n,).
            weights: strategies and their weights, which add up to 1.
            floor: serial of the oldest transition that is stored.
            generator: source of randomness.
        """
        if len(weights) == 1:
            (strategy,) = weights
            source = self._draw(serial, strategy, max(floor, self.freed), generator)
            return self._read(source, kind=int(strategy == DESIRED))
        which = draw_strategies(weights, len(serial), generator)
        goals = self._goals.new_empty(len(serial), *self._goals.shape[2:])
        for number, strategy in enumerate(weights):
            rows = (which == number).nonzero()[0]
            if len(rows):
                drawn = self.draw(serial[rows], {strategy: 1.0}, floor, generator)
                goals[torch.from_numpy(rows)] = drawn
        return goals

    def _draw(
        self,
        serial: Integers,
        strategy: str | Strategy,
        floor: int,
        generator: Generator | None,
    ) -> Integers:
        """Draws the serials of the transitions that goals are from, (n,)."""
        if strategy in (RANDOM, DESIRED):
            return draw_integers(floor, np.full_like(serial, self.head), generator)
        trajectory, step = self.find(serial)
        names = trajectory.tolist()
        steps = [self._steps[t] for t in names]
        end = np.array([len(s) for s in steps], dtype=np.int64)
        first = np.zeros_like(end)
        if strategy not in LOOKING_AHEAD:
            pairs = zip(steps, names, strict=True)
            first = np.minimum([bisect_left(s, floor - t) for s, t in pairs], step)
        chosen = choose_steps(strategy, step, first, end, generator).tolist()
        distance = [s[i] for s, i in zip(steps, chosen, strict=True)]
        return trajectory + np.array(distance, dtype=np.int64)

    # -- saving -----------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Returns a copy of everything, as tensors, numbers, lists and dicts."""
        return {
            "tracker": self.tracker.state(),
            "freed": self.freed,
            "goals": self._goals.clone(),
            "distance": torch.from_numpy(self._distance.copy()),
            "steps": {name: steps.tolist() for name, steps in self._steps.items()},
        }

    def load(self, state: dict[str, Any]) -> None:
        """Takes the state that another memory returned."""
        self.tracker.load(state["tracker"])
        self.freed = state["freed"]
        self._goals = state["goals"].clone()
        self._distance = state["distance"].numpy().copy()
        self._steps = {t: array("i", steps) for t, steps in state["steps"].items()}
