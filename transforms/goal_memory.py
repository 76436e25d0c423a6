"""The goals of the transitions that a buffer holds."""

from __future__ import annotations

import copy
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
    draw_uniform,
)
from torch_panda.transforms.trajectories import Integers, TrajectoryTracker


class GoalMemory:
    """Finds the goal achieved at any stored step of a transition's trajectory.

    Every transition has a serial number, in the order of writing. A round-robin buffer
    overwrites its oldest rows, so it holds the last serials; what lies ahead of a
    stored transition in its trajectory was written later, so it is stored too. A ring
    holds the goals of every serial, and a growing array the serials of a trajectory,
    which is named by its first one; the others are kept as distances from it. Only the
    goals are torch's, whose operations on few numbers take three times as long.
    """

    def __init__(self, keeps_desired: bool = False) -> None:
        self._kinds = 2 if keeps_desired else 1
        self.tracker = TrajectoryTracker()
        self.freed = 0  # serial of the oldest transition that is remembered
        self._goals = torch.zeros(0, device="cpu")  # (rows, achieved or desired, *goal)
        self._distance = np.zeros(0, dtype=np.int32)  # from the first serial, (rows,)
        self._steps: dict[int, array[int]] = {}  # trajectory -> distances, ascending

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

        The arguments are those of `TrajectoryTracker.follow`, what was asked for, (n,
        *goal), and how many transitions the buffer holds and, if known, can hold.
        """
        head = self.tracker.count
        self._make_room(head, achieved, stored, capacity)
        order, length, trajectory = self.tracker.follow(
            ids, done, achieved, root, self._last_achieved
        )
        serial = torch.arange(head, head + len(order), device=self._goals.device)
        kinds = [x.to(self._goals) for x in (achieved, desired)[: self._kinds]]
        self._goals.index_copy_(0, serial % len(self._goals), torch.stack(kinds, 1))
        distance = head + order - trajectory.repeat(length)
        self._distance[(head + order) % len(self._distance)] = distance
        numbers, ends = distance.tolist(), length.cumsum()
        starts = (ends - length).tolist()
        for t, i, j in zip(trajectory.tolist(), starts, ends.tolist(), strict=True):
            self._steps.setdefault(t, array("i")).extend(numbers[i:j])
        return serial

    def _last_achieved(self, trajectories: list[int]) -> Tensor:
        return self._read(np.array([t + self._steps[t][-1] for t in trajectories]))

    def _make_room(
        self, head: int, goals: Tensor, stored: int, capacity: int | None
    ) -> None:
        """Makes the ring hold some more; the first goals tell type and device."""
        rows = len(self._distance)
        if not rows:
            self._goals = goals.new_zeros(0, self._kinds, *goals.shape[1:])
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
        larger = self._goals.new_zeros(room, *self._goals.shape[1:])
        if len(serial):
            old, new = serial % rows, serial % room
            distance[new] = self._distance[old]
            larger[torch.from_numpy(new)] = self._goals[torch.from_numpy(old)]
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
        step = (bisect_left(self._steps[t], s - t) for s, t in pairs)
        return trajectory, np.fromiter(step, np.int64, len(serial))

    def draw(
        self, serial: Integers, weights: Weights, floor: int, rng: Generator | None
    ) -> Tensor:
        """Draws a goal for each of some remembered transitions, (n, *goal).

        They are those of the serials, (n,); `floor` is the serial of the oldest one
        that is stored.
        """
        if len(weights) == 1:
            (strategy,) = weights
            source = self._draw(serial, strategy, max(floor, self.freed), rng)
            return self._read(source, kind=int(strategy == DESIRED))
        limits = np.cumsum([*weights.values()])[:-1]
        which = limits.searchsorted(draw_uniform(len(serial), rng), side="right")
        goals = self._goals.new_empty(len(serial), *self._goals.shape[2:])
        for number, strategy in enumerate(weights):
            rows = (which == number).nonzero()[0]
            drawn = self.draw(serial[rows], {strategy: 1.0}, floor, rng)
            goals[torch.from_numpy(rows)] = drawn
        return goals

    def _draw(
        self,
        serial: Integers,
        strategy: str | Strategy,
        floor: int,
        rng: Generator | None,
    ) -> Integers:
        """Draws the serials of the transitions that goals are from, (n,)."""
        if strategy in (RANDOM, DESIRED):
            return draw_integers(floor, np.full_like(serial, self.tracker.count), rng)
        trajectory, step = self.find(serial)
        names = trajectory.tolist()
        steps = [self._steps[t] for t in names]
        end = np.fromiter(map(len, steps), np.int64, len(steps))
        first = np.zeros_like(end)
        if strategy not in LOOKING_AHEAD:
            oldest = (bisect_left(self._steps[t], floor - t) for t in names)
            first = np.minimum(np.fromiter(oldest, np.int64, len(steps)), step)
        chosen = choose_steps(strategy, step, first, end, rng).tolist()
        distance = (s[i] for s, i in zip(steps, chosen, strict=True))
        return trajectory + np.fromiter(distance, np.int64, len(steps))

    def state(self) -> dict[str, Any]:
        """Returns a copy of everything, as tensors, numbers, lists and dicts."""
        rings = self._goals, torch.from_numpy(self._distance)
        steps = {t: steps.tolist() for t, steps in self._steps.items()}
        state = {"freed": self.freed, "rings": rings, "steps": steps}
        return copy.deepcopy({**state, "tracker": vars(self.tracker)})

    def load(self, state: dict[str, Any]) -> None:
        """Takes the state that another memory returned."""
        state = copy.deepcopy(state)
        self.freed = state["freed"]
        self._goals, self._distance = state["rings"][0], state["rings"][1].numpy()
        self._steps = {t: array("i", steps) for t, steps in state["steps"].items()}
        self.tracker.load(state["tracker"])
