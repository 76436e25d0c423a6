"""The goals of the transitions that a buffer holds."""

import copy
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor

from torch_panda.transforms import strategies
from torch_panda.transforms.strategies import Integers, Weights

Goals = NDArray[Any]  # (n, *goal)
_NEW = (-1, 0, b"")


class GoalMemory:
    """Finds the goal achieved at any stored step of a transition's trajectory.

    Transitions are numbered in the order of writing: their serials. A round-robin
    buffer overwrites its oldest rows, so it holds the last serials, and with a
    transition all that lies ahead of it. A ring holds their trajectories and steps. The
    goals of one lie, in order of time, in a region of `_goals`; a full one is moved.

    A transition goes on with the trajectory of its id, unless that was done, or got to
    another goal than this one begins with, if any ever begins where one before got to.
    """

    def __init__(self) -> None:
        self.count = 0  # transitions so far: serial of the next one
        self.freed = 0  # serial of the oldest transition that is remembered
        # What may go on: id -> trajectory, its next step, and the goal it got to.
        self.open: dict[int, tuple[int, int, bytes]] = {}
        self._links = False  # whether one ever began with the goal before it
        self._ring = np.zeros((0, 2), dtype=np.int32)  # their trajectories and steps
        # Of trajectories: their first step, the end, where in `_goals` step 0 would be,
        # up to which step there is room, and where in `_goals` their region begins.
        self._table = np.zeros((64, 5), dtype=np.int32)
        self._unused = [*range(64)]  # numbers of no trajectory that is remembered
        # Achieved and, if kept, desired: (places, kinds, *goal).
        self._goals: Goals = np.zeros((0, 1), dtype=np.float32)
        self._used = 0  # places that were ever part of a region
        self._free_regions: dict[int, list[int]] = {}  # size -> where they begin

    def write(
        self,
        ids: Integers,
        done: NDArray[np.bool_],
        root: Goals | None,
        goals: list[Goals],
        stored: int,
    ) -> Integers:
        """Takes transitions that are about to be stored; returns their serials, (n,).

        Args:
            ids: of their trajectories, or environments, (n,).
            done: whether these end, (n,).
            root: goals that had been achieved before them, if known, (n, *goal).
            goals: that they achieved and, to draw "desired" ones, were asked for.
            stored: how many transitions before them are still stored.
        """
        if not self.count:
            shape = (0, len(goals), *goals[0].shape[1:])
            self._goals = np.zeros(shape, np.result_type(*goals))
        self._make_room(len(ids), stored)
        serial = np.arange(self.count, self.count + len(ids))
        trajectory, step = self._place(ids, done, root, goals[0])
        row = serial % len(self._ring)
        self._ring[row, 0], self._ring[row, 1] = trajectory, step
        _, end, base, room, _ = self._table.T
        end[trajectory] = step + 1  # of one's several steps the last one stays
        for t in set(trajectory[step >= room.take(trajectory)].tolist()):
            self._move(t)
        place = base.take(trajectory) + step
        for kind, values in enumerate(goals):
            self._goals[place, kind] = values
        self.count += len(ids)
        return serial

    def _place(
        self, ids: Integers, done: Goals, root: Goals | None, achieved: Goals
    ) -> Integers:
        """Returns the trajectories and steps of transitions, (2, n)."""
        before = [b""] * len(ids) if root is None else _as_bytes(root)
        after = before if root is None else _as_bytes(achieved)
        trajectories, steps = [], []
        rows = zip(ids.tolist(), done.tolist(), before, after, strict=True)
        for i, ends, b, a in rows:
            t, s, goal = self.open.pop(i, _NEW)
            self._links = self._links or goal == b != b""
            if t < 0 or (self._links and goal != b):
                t, s = self._begin(), 0
            if not ends:
                self.open[i] = t, s + 1, a
            trajectories.append(t)
            steps.append(s)
        return np.array([trajectories, steps], dtype=np.int32)

    def _begin(self) -> int:
        """Returns the number of a new trajectory."""
        if not self._unused:
            number = len(self._table)
            self._table = _grow(self._table, 2 * number)
            self._unused = [*range(number, len(self._table))]
        return self._unused.pop()

    def _move(self, trajectory: int) -> None:
        """Moves a trajectory to where its steps fit, and some more."""
        first, end, base, room, _ = self._table[trajectory].tolist()
        goals = self._goals[base + first : base + room].copy()
        self._release(trajectory)
        size = 1 << max(15, 9 * (end - first) // 8).bit_length()
        free = self._free_regions.setdefault(size, [])
        if not free:
            free.append(self._used)
            self._used += size
            self._goals = _grow(self._goals, self._used)
        start = free.pop()
        self._goals[start : start + len(goals)] = goals
        self._table[trajectory, 2:] = start - first, first + size, start

    def _release(self, trajectory: int) -> None:
        """Lets the region of a trajectory, if it has one, be used again."""
        base, room, start = self._table[trajectory, 2:].tolist()
        if room:
            self._free_regions[base + room - start].append(start)

    def _make_room(self, number: int, stored: int) -> None:
        """Makes the ring hold more transitions, and a few, so that freeing is rare."""
        rows, end = len(self._ring), self.count + number
        if end - self.freed <= rows:
            return
        self.free(self.count - stored)
        serial = np.arange(self.freed, self.count)
        if (needed := end - self.freed + rows // 64) > rows:
            placed = self.find(serial)
            self._ring = _grow(self._ring, needed)
            self._ring[serial % len(self._ring)] = placed.T

    def free(self, floor: int) -> None:
        """Forgets the transitions below a serial: they have been overwritten."""
        if floor <= self.freed:
            return
        trajectory, step = self.find(np.arange(self.freed, floor))
        first, end = self._table.T[:2]
        first[trajectory] = step + 1
        gone = set(trajectory[first[trajectory] == end[trajectory]].tolist())
        for t in gone:
            self._release(t)
            self._table[t] = 0
        self._unused += gone
        self.open = {i: known for i, known in self.open.items() if known[0] not in gone}
        self.freed = floor

    def find(self, serial: Integers) -> Integers:
        """Returns trajectories and steps of transitions, (2, n)."""
        return self._ring.take(serial % len(self._ring), axis=0).T

    def is_open(self, serial: Integers) -> Any:  # noqa: ANN401 (booleans)
        """Tells which transitions' trajectories may go on, (n,)."""
        return np.isin(self.find(serial)[0], [t for t, _, _ in self.open.values()])

    def draw(self, serial: Integers, weights: Weights, rng: Generator | None) -> Goals:
        """Draws a goal for each serial, (n,), by strategies: (n, *goal)."""
        if len(weights) > 1:
            limits = np.cumsum([*weights.values()])[:-1]
            u = strategies.draw_uniform(len(serial), rng)
            which = limits.searchsorted(u, side="right")
            goals = np.empty((len(serial), *self._goals.shape[2:]), self._goals.dtype)
            for number, strategy in enumerate(weights):
                rows = (which == number).nonzero()[0]
                goals[rows] = self.draw(serial[rows], {strategy: 1.0}, rng)
            return goals
        (strategy,) = weights
        of_any = strategy in (strategies.RANDOM, strategies.DESIRED)
        if of_any:
            end = np.full(len(serial), self.count)
            serial = strategies.draw_integers(self.freed, end, rng)
        trajectory, step = self.find(serial)
        first, end, base, _, _ = self._table.take(trajectory, axis=0).T
        if not of_any:
            step = strategies.choose_steps(strategy, step, first, end, rng)
        kind = int(strategy == strategies.DESIRED)
        return self._goals[:, kind].take(base + step, axis=0)

    def state(self) -> dict[str, Any]:
        """Returns a copy of everything, as tensors, numbers, strings and containers."""
        own, array = vars(self).items(), np.ndarray
        state = {k: torch.from_numpy(v) if isinstance(v, array) else v for k, v in own}
        state["open"] = {i: (t, s, goal.hex()) for i, (t, s, goal) in self.open.items()}
        return copy.deepcopy(state)

    def load(self, state: dict[str, Any]) -> None:
        """Takes the state that another memory returned."""
        for name, value in copy.deepcopy(state).items():
            setattr(self, name, value.numpy() if isinstance(value, Tensor) else value)
        known = state["open"] if self._links else {}  # else used again, ids might not
        self.open = {i: (t, s, bytes.fromhex(g)) for i, (t, s, g) in known.items()}


def _as_bytes(goals: Goals) -> list[bytes]:
    """Returns each of the goals, (n, *goal), as bytes, which are fast to compare."""
    flat = np.ascontiguousarray(goals).reshape(len(goals), -1)
    return flat.view(f"V{flat[0].nbytes}").ravel().tolist()


def _grow(array: NDArray[Any], size: int) -> NDArray[Any]:
    """Returns an array with zeros appended, `size` rows long or a bit longer."""
    if (length := len(array)) >= size:
        return array
    more = max(size, length + length // 32, 256) - length
    return np.concatenate([array, np.zeros((more, *array.shape[1:]), array.dtype)])
