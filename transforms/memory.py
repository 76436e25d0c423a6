"""Memory of the stored transitions: their trajectories, steps and goals."""

import weakref
from array import array
from collections import Counter
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Generator
from torchrl.data import ReplayBuffer

from torch_panda.transforms.checks import (
    DONE,
    UNKNOWN_ROWS,
    Keys,
    check_entries,
    check_goals_agree,
)
from torch_panda.transforms.strategies import (
    DESIRED,
    RANDOM,
    Integers,
    Mixture,
    choose_steps,
    draw_integers,
)

Goals = NDArray[Any]  # (n, *goal)

SERIAL_KEY = "hindsight_serial"  # serial numbers of stored transitions
# Columns of `TrajectoryMemory._rings`.
NUMBER, STEP, ACHIEVED_GOAL, DESIRED_GOAL = range(4)


class TrajectoryMemory:
    """Remembers where each stored transition is in its trajectory, and its goals.

    Each transition gets a serial number: 0, 1, 2 and so on, in the order of writing. A
    round-robin buffer overwrites its oldest rows first. So it always holds the newest
    transitions, and for each of them all later steps of the same trajectory.

    `_rings` holds the trajectory number, the step and the goals of transition i in row
    ``i % size``. `_serials` leads from a trajectory number to the serial numbers of its
    transitions. To draw a goal for a transition means to choose one of these.

    Only one thread may write to the buffer. The memory takes transitions in the order
    in which they pass through the transform, and two threads may store them in another.

    A new transition continues the open trajectory with the same id. (A trajectory is
    open until one of its transitions is done.) But a second collector may reuse an id
    that the first one left open. The memory detects this by the root goal, which is the
    achieved goal before a step. Within a trajectory, the root goal equals the goal that
    the previous step achieved. If the two differ, a new trajectory begins. In some data
    the two differ everywhere, so the memory checks them only after it has seen them
    equal once.

    Args:
        keys: Keys of the entries of a transition.
        single_env: Whether data of one dimension and without ids are successive steps
            of one environment.
        capacity: Number of transitions to remember without a buffer. None means all.
    """

    def __init__(self, keys: Keys, *, single_env: bool, capacity: int | None) -> None:
        self._keys, self._single_env, self._capacity = keys, single_env, capacity
        self._buffer: weakref.ref[ReplayBuffer] | None = None
        # Number of transitions in the buffer before the last write, and number of
        # transitions of this write.
        self._last_write = 0, 0
        self.count = 0  # transitions written so far: the next serial number
        self.oldest = 0  # serial number of the oldest remembered transition
        self._rings: list[NDArray[Any]] = []
        # By trajectory number: the oldest remembered step, the newest step + 1, and the
        # serial numbers of these steps, perhaps after those of forgotten steps.
        self._first = self._end = np.zeros(0, np.int64)
        self._serials: list[array[int]] = []
        self._free: list[int] = []  # trajectory numbers that are not in use
        # Open trajectories by id: trajectory number, next step, last achieved goal.
        self._open: dict[int, tuple[int, int, bytes]] = {}
        self._checks_root_goals = False

    def remember(
        self, batch: TensorDictBase, buffer: ReplayBuffer | None
    ) -> TensorDictBase:
        """Remembers transitions and tags them with their serial numbers.

        Args:
            batch: Transitions, [*environments, time].
            buffer: The buffer that will store them, if there is one.
        """
        shape, keys, flat = batch.batch_size, self._keys, batch
        if batch.ndim > 1:
            # Put time first, because a storage [environments, time] fills up along
            # time. Serial numbers then rise in the order in which rows are overwritten.
            selected = keys.trajectory, keys.achieved_goal, *keys.remembered
            flat = batch.select(*selected, strict=False).movedim(-1, 0).reshape(-1)
        root_goals = flat.get(keys.achieved_goal, None)
        entries = [flat.get(key, None) for key in keys.remembered]
        if any(entry is None for entry in entries):
            check_entries(batch, keys.remembered)  # raises
        achieved, desired, _, done = entries
        if done.numel() != len(flat):
            raise ValueError(
                f"{DONE!r} must hold one value per transition, got {tuple(done.shape)} "
                f"in data of batch size {list(shape)}: if the transitions have further "
                "dimensions, add these to the batch size, such as [episodes, steps]"
            )
        check_goals_agree(flat, keys)
        ids = self._get_ids(flat, shape)
        serials = self.write(
            ids,
            done.numpy(force=True).reshape(-1),
            None if root_goals is None else root_goals.numpy(force=True),
            (achieved.numpy(force=True), desired.numpy(force=True)),
            *self._count_stored(buffer, shape),
        )
        tags = torch.from_numpy(serials)
        if batch.ndim > 1:
            tags = tags.view(shape[-1], *shape[:-1]).movedim(0, -1)
        return batch.set(SERIAL_KEY, tags.to(desired.device))

    def _count_stored(
        self, buffer: ReplayBuffer | None, shape: torch.Size
    ) -> tuple[int, int]:
        """Returns how many transitions the buffer holds, and how many it can hold.

        Args:
            buffer: The buffer. Without one, the transform itself holds the transitions.
            shape: Shape of the batch that will be written, [*environments, time].

        Raises:
            RuntimeError: The transform belongs to another buffer, the buffer holds rows
                that are not remembered, or it lacks rows that are.
        """
        remembered = self.count - self.oldest
        if buffer is None:
            return remembered, self._capacity or 2**62
        owner = self._buffer and self._buffer()
        if owner is not None and owner is not buffer:
            raise RuntimeError(
                "this transform already belongs to another replay buffer: make one "
                "transform for each buffer, or call empty() on the transform to forget "
                "the other buffer's transitions"
            )
        self._buffer = weakref.ref(buffer)
        stored, num_envs = len(buffer.storage), shape[:-1].numel()
        capacity = -(buffer.storage.max_size // -num_envs) * num_envs
        if stored > remembered:
            raise RuntimeError(UNKNOWN_ROWS)
        before, written = self._last_write
        if 0 < stored - before < written and stored < capacity:
            raise RuntimeError(
                f"{written} rows passed through hindsight, but the buffer has appended "
                f"only {stored - before}: put transforms that drop rows after it; do "
                "not use a ConsumingSampler or consume_after_n_samples"
            )
        self._last_write = stored, shape.numel()
        return stored, capacity

    def _get_ids(self, flat: TensorDictBase, shape: torch.Size) -> Integers:
        """Returns the trajectory id of each row, (n,).

        If the data have no ids, each row gets the number of its environment.

        Args:
            flat: Transitions in order of time, (n,).
            shape: Batch shape before flattening, [*environments, time].
        """
        key = self._keys.trajectory
        ids = flat.get(key, None)
        if ids is None:
            if len(shape) < 2 and not self._single_env:
                raise ValueError(
                    f"there are no trajectory ids at {key!r}, so the trajectory of a "
                    "row is unknown: keep the collector's ids, name other ids "
                    "(trajectory_key=...), extend with [num_envs, time], or pass "
                    "single_env=True for steps of one environment"
                )
            return np.arange(len(flat)) % shape[:-1].numel()
        if ids.numel() != len(flat):
            raise ValueError(
                f"{key!r} must hold one id per transition, got {tuple(ids.shape)} for "
                f"{tuple(shape)}"
            )
        return ids.numpy(force=True).reshape(-1)

    def is_shuffled(self, data: TensorDictBase) -> bool:
        """Returns whether most transitions do not continue the one before them.

        That is, they begin a new trajectory, although the last transition with the same
        id did not end one.

        Args:
            data: All transitions that are remembered, (n,).
        """
        ids = data.get(self._keys.trajectory, None)
        num_ids = 1 if ids is None else len(ids.unique())
        num_begun = num_ids + int(data.get(DONE).sum())
        steps = self.find(np.arange(len(data)))[1]
        return bool((steps == 0).sum() > num_begun + len(data) / 2)

    def write(
        self,
        ids: Integers,
        done: NDArray[np.bool_],
        root_goals: Goals | None,
        goals: tuple[Goals, Goals],
        num_stored: int,
        capacity: int,
    ) -> Integers:
        """Remembers transitions that are about to be stored.

        Args:
            ids: Ids of the trajectories, or numbers of the environments, (n,).
            done: Whether the transition ends its trajectory, (n,).
            root_goals: Achieved goals before the transitions, if the data have them.
            goals: Achieved goals after the transitions, and desired goals.
            num_stored: Number of transitions in the buffer before these are written.
            capacity: Number of transitions that the buffer can hold.

        Returns:
            Serial numbers of the transitions, (n,).
        """
        if not self._rings:
            positions = np.zeros(0, np.int32), np.zeros(0, np.int32)
            self._rings = [*positions, *(values[:0].copy() for values in goals)]
        self.forget(self.count - num_stored)
        self._make_room(len(ids), capacity)
        serials = np.arange(self.count, self.count + len(ids))
        if root_goals is None:  # empty bytes stand for unknown goals
            roots = achieved = [b""] * len(ids)
        else:
            roots, achieved = _to_bytes(root_goals), _to_bytes(goals[0])
        numbers, steps = [], []
        for serial, trajectory_id, is_done, root, goal in zip(
            serials.tolist(), ids.tolist(), done.tolist(), roots, achieved, strict=True
        ):
            number, step, last_goal = self._open.pop(trajectory_id, (-1, 0, b""))
            if root == last_goal != b"":
                self._checks_root_goals = True
            if number < 0 or (self._checks_root_goals and root != last_goal):
                number, step = self._take_number(), 0
            if not is_done:
                self._open[trajectory_id] = number, step + 1, goal
            numbers.append(number)
            steps.append(step)
            self._serials[number].append(serial)
        # If a trajectory occurs several times, numpy keeps the last value.
        self._end[numbers] = np.array(steps) + 1
        rows = serials % len(self._rings[NUMBER])
        for ring, values in zip(self._rings, (numbers, steps, *goals), strict=True):
            ring[rows] = values
        self.count += len(ids)
        self.forget(self.count - capacity)
        return serials

    def _take_number(self) -> int:
        """Returns a trajectory number that is not in use."""
        if not self._free:
            size = len(self._serials)
            self._free = [*range(size, max(64, 2 * size))]
            self._serials += [array("q") for _ in self._free]
            new = np.zeros(len(self._free), np.int64)
            self._first, self._end = (
                np.concatenate([x, new]) for x in (self._first, self._end)
            )
        number = self._free.pop()
        self._first[number] = 0
        return number

    def _make_room(self, n: int, capacity: int) -> None:
        """Enlarges the rings if they have no room for n more transitions."""
        size, needed = len(self._rings[NUMBER]), self.count + n - self.oldest
        if needed <= size:
            return
        new_size = max(needed, min(2 * size, capacity))
        serials = np.arange(self.oldest, self.count)
        for column, ring in enumerate(self._rings):
            new = np.zeros((new_size, *ring.shape[1:]), ring.dtype)
            new[serials % new_size] = ring[serials % max(size, 1)]
            self._rings[column] = new

    def forget(self, oldest: int) -> None:
        """Forgets overwritten transitions: those with serial numbers below `oldest`."""
        if oldest <= self.oldest:
            return
        numbers, _ = self.find(np.arange(self.oldest, oldest))
        for number, n in Counter(numbers.tolist()).items():
            self._first[number] += n
            length, serials = (
                self._end[number] - self._first[number],
                self._serials[number],
            )
            # Not on every call, because it moves all other entries.
            if len(serials) > 2 * length:
                del serials[: len(serials) - length]
            if not length:
                self._free.append(number)
                self._open = {
                    trajectory_id: trajectory
                    for trajectory_id, trajectory in self._open.items()
                    if trajectory[0] != number
                }
        self.oldest = oldest

    def find(self, serials: Integers) -> tuple[Integers, Integers]:
        """Returns trajectory numbers and steps of transitions, (n,) each."""
        rows = serials % len(self._rings[NUMBER])
        return self._rings[NUMBER].take(rows), self._rings[STEP].take(rows)

    def get_goals(self, serials: Integers, column: int = ACHIEVED_GOAL) -> Goals:
        """Returns achieved or desired goals of transitions, (n, *goal)."""
        ring = self._rings[column]
        return ring.take(serials % len(ring), axis=0)

    def end_trajectories(self) -> None:
        """Ends all trajectories: the next row of each id begins a new trajectory."""
        self._open.clear()

    def draw(
        self, serials: Integers, mixture: Mixture, generator: Generator | None
    ) -> tuple[Integers, Goals]:
        """Draws a hindsight goal for each transition.

        Args:
            serials: Serial numbers of the transitions, (n,).
            mixture: Strategies that choose where each goal comes from.
            generator: Generator of the random draws; None means torch's global one.

        Returns:
            Serial numbers of the transitions whose goals were drawn, (n,), and these
            goals, (n, *goal).
        """
        achieved, desired = self._rings[ACHIEVED_GOAL], self._rings[DESIRED_GOAL]
        shape = len(serials), *achieved.shape[1:]
        goals = np.empty(shape, np.result_type(achieved, desired))
        sources = np.empty(len(serials), np.int64)
        for strategy, rows in mixture.split(len(serials), generator):
            if strategy in (RANDOM, DESIRED):
                end = np.full(len(sources[rows]), self.count)
                sources[rows] = draw_integers(self.oldest, end, generator)
            else:
                numbers, steps = self.find(serials[rows])
                first, end = self._first.take(numbers), self._end.take(numbers)
                chosen = choose_steps(
                    strategy, steps - first, end - first, mixture.discount, generator
                )
                sources[rows] = self._find_serials(
                    numbers, first + chosen, serials[rows] + first + chosen - steps
                )
            column = DESIRED_GOAL if strategy == DESIRED else ACHIEVED_GOAL
            goals[rows] = self.get_goals(sources[rows], column)
        return sources, goals

    def _find_serials(
        self, numbers: Integers, steps: Integers, guess: Integers
    ) -> Integers:
        """Returns the serial numbers of steps of trajectories, (n,).

        Args:
            numbers: Trajectory numbers, (n,).
            steps: Steps in these trajectories, (n,).
            guess: Serial numbers if the rows of a trajectory follow each other, (n,).
                Checking these takes a fifth of the time of looking up all of them.
        """
        serials = guess.clip(self.oldest, self.count - 1)
        found_numbers, found_steps = self.find(serials)
        is_wrong = (found_numbers != numbers) | (found_steps != steps)
        for i in is_wrong.nonzero()[0].tolist():
            number = numbers[i]
            serials[i] = self._serials[number][steps[i] - self._end[number]]
        return serials

    def state(self) -> dict[str, Any]:
        """Returns a copy of all contents, as tensors, numbers, strings, containers."""
        serials = np.arange(self.oldest, self.count)
        rings = [ring[serials % max(len(ring), 1)] for ring in self._rings]
        return {
            "count": self.count,
            "rings": [torch.from_numpy(ring) for ring in rings],
            "open": {
                trajectory_id: (number, step, goal.hex())
                for trajectory_id, (number, step, goal) in self._open.items()
            },
            "checks_root_goals": self._checks_root_goals,
        }

    def load(self, state: dict[str, Any]) -> None:
        """Restores a copy of the contents that `state` returned, in an empty self."""
        self.count = self.oldest = state["count"]
        rings = [ring.numpy(force=True) for ring in state["rings"]]
        if not rings or not len(rings[NUMBER]):
            return
        numbers, steps = rings[NUMBER].tolist(), rings[STEP].tolist()
        self.oldest -= len(numbers)
        self._end = np.zeros(max(numbers) + 1, np.int64)
        self._serials = [array("q") for _ in self._end]
        self._end[numbers] = np.array(steps) + 1
        for serial, number in enumerate(numbers, self.oldest):
            self._serials[number].append(serial)
        self._first = self._end - np.array([*map(len, self._serials)])
        self._free = [i for i, rows in enumerate(self._serials) if not rows]
        # Row i of the state is transition `oldest + i`: move it to its place.
        self._rings = [np.roll(ring, self.oldest, axis=0) for ring in rings]
        # The next rows may come from a new collector that reuses the ids. Only the
        # check of root goals would detect this. Without it, end all trajectories.
        self._checks_root_goals = state["checks_root_goals"]
        if self._checks_root_goals:
            self._open = {
                trajectory_id: (number, step, bytes.fromhex(goal))
                for trajectory_id, (number, step, goal) in state["open"].items()
            }

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_buffer": None}  # a weak reference cannot be pickled


def _to_bytes(goals: Goals) -> list[bytes]:
    """Returns the bytes of each goal of (n, *goal). Python compares bytes fast."""
    flat = np.ascontiguousarray(goals).reshape(len(goals), -1)
    return flat.view(f"V{flat[0].nbytes}").ravel().tolist()
