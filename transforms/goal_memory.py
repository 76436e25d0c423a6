"""Goals of the transitions in a replay buffer, in the order of their trajectories."""

import copy
import weakref
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor
from torchrl.data import ReplayBuffer

from torch_panda.transforms.strategies import (
    DESIRED,
    RANDOM,
    Integers,
    Mixture,
    choose_steps,
    draw_integers,
)

Goals = NDArray[Any]  # (n, *goal)

# Where a transition stands in its trajectory.
_POSITION = np.dtype([("trajectory", np.int32), ("step", np.int32)])
_TRAJECTORY = np.dtype(
    [
        ("first", np.int32),  # oldest step that the buffer still holds
        ("end", np.int32),  # one more than the last step
        ("offset", np.int32),  # step s has its goals at row `offset + s` of the goals
        ("limit", np.int32),  # steps below this one fit into the region
        ("region", np.int32),  # first row of the region of the goals
    ]
)
_MIN_REGION = 16  # rows


class GoalMemory:
    """Remembers the goals of all stored transitions, and draws hindsight goals.

    Serial numbers count the transitions in the order in which they are written. A
    round-robin buffer overwrites its oldest rows first. It therefore holds the
    transitions with the largest serial numbers, and with every transition also all
    later steps of its trajectory.

    Three arrays lead from a serial number to goals:

    - a ring has the trajectory and step of every remembered transition;
    - a table has a row for every remembered trajectory, see `_TRAJECTORY`;
    - `_goals` has a contiguous region for each trajectory, one row per step. A full
      region is copied into a larger one.

    The root goal of a row is the achieved goal before its step. A row extends the open
    trajectory with its id, unless that trajectory's last achieved goal differs from the
    row's root goal: then a new collector reuses the id. Some data have root goals that
    never equal the goals achieved before them, so root goals are ignored until two of
    them are equal.
    """

    def __init__(self) -> None:
        self.buffer: weakref.ref[ReplayBuffer] | None = None  # whose rows these are
        self.count = 0  # serial number of the next transition
        self.oldest = 0  # serial number of the oldest remembered transition
        # Open trajectories: id -> (number, next step, bytes of the last achieved goal).
        self._open: dict[int, tuple[int, int, bytes]] = {}
        self._roots_match = False  # whether a root goal ever equalled the goal before
        self._ring = np.zeros(0, _POSITION)  # indexed by serial number, modulo its size
        self._trajectories = np.zeros(64, _TRAJECTORY)  # indexed by trajectory number
        self._free_numbers = [*range(64)]  # trajectory numbers that are not in use
        # Achieved goals and, if they are needed, desired goals: (rows, 1 or 2, *goal).
        self._goals: Goals = np.zeros((0, 1), dtype=np.float32)
        self._allocated = 0  # rows of `_goals` that belong to a region or a free region
        self._free_regions: dict[int, list[int]] = {}  # size -> first rows

    def write(
        self,
        ids: Integers,
        done: NDArray[np.bool_],
        roots: Goals | None,
        goals: list[Goals],
        stored: int,
    ) -> Integers:
        """Remembers transitions that are about to be stored.

        Args:
            ids: Ids of the trajectories, or numbers of the environments, (n,).
            done: Whether the transition ends its trajectory, (n,).
            roots: Achieved goals before the transitions, if the data have them.
            goals: Achieved goals after the transitions and, if "desired" is among the
                strategies, their desired goals.
            stored: Number of earlier transitions that the buffer still holds.

        Returns:
            Serial numbers of the transitions, (n,).
        """
        if not self.count:
            shape = (0, len(goals), *goals[0].shape[1:])
            self._goals = np.zeros(shape, np.result_type(*goals))
        self._make_room(len(ids), stored)
        serials = np.arange(self.count, self.count + len(ids))
        numbers, steps = self._assign(ids, done, roots, goals[0])
        slots = serials % len(self._ring)
        self._ring["trajectory"][slots] = numbers
        self._ring["step"][slots] = steps

        self._trajectories["end"][numbers] = steps + 1  # the last of equal numbers wins
        is_full = steps >= self._trajectories["limit"].take(numbers)
        for number in set(numbers[is_full].tolist()):
            self._enlarge(number)
        rows = self._trajectories["offset"].take(numbers) + steps
        for column, values in enumerate(goals):
            self._goals[rows, column] = values
        self.count += len(ids)
        return serials

    def _assign(
        self,
        ids: Integers,
        done: NDArray[np.bool_],
        roots: Goals | None,
        achieved: Goals,
    ) -> tuple[Integers, Integers]:
        """Returns trajectory numbers and steps of new transitions, (n,) each."""
        root_bytes = [b""] * len(ids) if roots is None else _to_bytes(roots)
        achieved_bytes = root_bytes if roots is None else _to_bytes(achieved)
        numbers, steps = [], []
        transitions = zip(
            ids.tolist(), done.tolist(), root_bytes, achieved_bytes, strict=True
        )
        for trajectory_id, is_done, root, goal in transitions:
            number, step, last_goal = self._open.pop(trajectory_id, (-1, 0, b""))
            if root == last_goal != b"":
                self._roots_match = True
            if number < 0 or (self._roots_match and root != last_goal):
                number, step = self._new_number(), 0
            if not is_done:
                self._open[trajectory_id] = number, step + 1, goal
            numbers.append(number)
            steps.append(step)
        return np.array(numbers, dtype=np.int32), np.array(steps, dtype=np.int32)

    def _new_number(self) -> int:
        """Returns a trajectory number that is not in use."""
        if not self._free_numbers:
            size = len(self._trajectories)
            self._trajectories = _grow(self._trajectories, 2 * size)
            self._free_numbers = [*range(size, len(self._trajectories))]
        return self._free_numbers.pop()

    def _enlarge(self, number: int) -> None:
        """Copies a trajectory's goals into a region in which its steps fit."""
        first, end, offset, limit, _ = self._trajectories[number].tolist()
        goals = self._goals[offset + first : offset + limit].copy()
        self._free_region(number)
        size = 1 << max(_MIN_REGION - 1, 9 * (end - first) // 8).bit_length()
        free = self._free_regions.setdefault(size, [])
        if not free:
            free.append(self._allocated)
            self._allocated += size
            self._goals = _grow(self._goals, self._allocated)
        region = free.pop()
        self._goals[region : region + len(goals)] = goals
        self._trajectories[number] = first, end, region - first, first + size, region

    def _free_region(self, number: int) -> None:
        """Frees the region of a trajectory, if it has one."""
        _, _, offset, limit, region = self._trajectories[number].tolist()
        if limit:
            self._free_regions[offset + limit - region].append(region)

    def _make_room(self, n: int, stored: int) -> None:
        """Makes room in the ring for n transitions, and for some more."""
        size, end = len(self._ring), self.count + n
        if end - self.oldest <= size:
            return
        self.forget(self.count - stored)
        needed = end - self.oldest + size // 64  # so that the ring rarely grows
        if needed > size:
            serials = np.arange(self.oldest, self.count)
            positions = self._ring.take(serials % size)
            self._ring = _grow(self._ring, needed)
            self._ring[serials % len(self._ring)] = positions

    def forget(self, oldest: int) -> None:
        """Forgets the transitions before serial number `oldest`: the buffer has."""
        if oldest <= self.oldest:
            return
        numbers, steps = self.find(np.arange(self.oldest, oldest))
        first, end = self._trajectories["first"], self._trajectories["end"]
        first[numbers] = steps + 1
        forgotten = set(numbers[first[numbers] == end[numbers]].tolist())
        for number in forgotten:
            self._free_region(number)
            self._trajectories[number] = 0
        self._free_numbers += forgotten
        self._open = {
            trajectory_id: trajectory
            for trajectory_id, trajectory in self._open.items()
            if trajectory[0] not in forgotten
        }
        self.oldest = oldest

    def find(self, serials: Integers) -> tuple[Integers, Integers]:
        """Returns trajectory numbers and steps of transitions, (n,) each."""
        positions = self._ring.take(serials % len(self._ring))
        return positions["trajectory"], positions["step"]

    def is_open(self, serials: Integers) -> NDArray[np.bool_]:
        """Returns whether the transitions' trajectories may still go on, (n,)."""
        open_numbers = [number for number, _, _ in self._open.values()]
        return np.isin(self.find(serials)[0], open_numbers)

    def end_trajectories(self) -> None:
        """Ends all trajectories: the next row of each id begins another one."""
        self._open.clear()

    def draw(
        self, serials: Integers, mixture: Mixture, generator: Generator | None
    ) -> Goals:
        """Draws a goal for each transition, (n,), by a mixture: (n, *goal)."""
        goals = np.empty((len(serials), *self._goals.shape[2:]), self._goals.dtype)
        for strategy, rows in mixture.split(len(serials), generator):
            own = serials[rows]
            if strategy in (RANDOM, DESIRED):
                end = np.full(len(own), self.count)
                own = draw_integers(self.oldest, end, generator)
            numbers, steps = self.find(own)
            trajectories = self._trajectories.take(numbers)
            if strategy not in (RANDOM, DESIRED):
                first, end = trajectories["first"], trajectories["end"]
                steps = choose_steps(
                    strategy, steps, first, end, mixture.discount, generator
                )
            column = int(strategy == DESIRED)
            goals[rows] = self._goals[:, column].take(
                trajectories["offset"] + steps, axis=0
            )
        return goals

    def state(self) -> dict[str, Any]:
        """Returns a copy of all contents, as tensors, numbers, strings, containers."""
        ring = self._ring.view(np.int32).reshape(-1, 2)
        table = self._trajectories.view(np.int32).reshape(-1, 5)
        return {
            "count": self.count,
            "freed": self.oldest,
            "open": {
                trajectory_id: (number, step, goal.hex())
                for trajectory_id, (number, step, goal) in self._open.items()
            },
            "_links": self._roots_match,
            "_ring": torch.from_numpy(ring.copy()),
            "_table": torch.from_numpy(table.copy()),
            "_unused": self._free_numbers.copy(),
            "_goals": torch.from_numpy(self._goals.copy()),
            "_used": self._allocated,
            "_free_regions": copy.deepcopy(self._free_regions),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Takes a copy of what another memory's `state` returned."""

        def to_array(tensor: Tensor) -> NDArray[Any]:
            return tensor.numpy(force=True).copy()

        self.count, self.oldest = state["count"], state["freed"]
        self._roots_match = state["_links"]
        # Root goals tell whether the next rows are of the same collector. Without
        # them, a new collector may reuse the ids, so that no trajectory may go on.
        self._open = {
            trajectory_id: (number, step, bytes.fromhex(goal))
            for trajectory_id, (number, step, goal) in state["open"].items()
            if self._roots_match
        }
        self._ring = to_array(state["_ring"]).view(_POSITION).ravel()
        self._trajectories = to_array(state["_table"]).view(_TRAJECTORY).ravel()
        self._free_numbers = [*state["_unused"]]
        self._goals, self._allocated = to_array(state["_goals"]), state["_used"]
        self._free_regions = copy.deepcopy(state["_free_regions"])

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "buffer": None}  # a weak reference cannot be pickled


def _to_bytes(goals: Goals) -> list[bytes]:
    """Returns each goal of (n, *goal) as bytes, which are fast to compare."""
    flat = np.ascontiguousarray(goals).reshape(len(goals), -1)
    return flat.view(f"V{flat[0].nbytes}").ravel().tolist()


def _grow(array: NDArray[Any], size: int) -> NDArray[Any]:
    """Returns the array with zeros appended, so that it has at least `size` rows."""
    length = len(array)
    if length >= size:
        return array
    new_length = max(size, length + length // 32, 256)
    zeros = np.zeros((new_length - length, *array.shape[1:]), array.dtype)
    return np.concatenate([array, zeros])
