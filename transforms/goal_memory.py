"""Goals of all transitions in a replay buffer, grouped by trajectory."""

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

# One entry per remembered transition. Steps count from 0 in each trajectory.
_POSITION = np.dtype([("trajectory", np.int32), ("step", np.int32)])
# One entry per remembered trajectory. Its goals are in a block of successive rows.
_TRAJECTORY = np.dtype(
    [
        ("first", np.int32),  # oldest step that is still remembered
        ("end", np.int32),  # newest step + 1
        ("offset", np.int32),  # the goals of step s are in row `offset + s`
        ("limit", np.int32),  # the block has room for steps below this number
        ("block", np.int32),  # first row of the block
    ]
)
_MIN_BLOCK = 16  # rows


class GoalMemory:
    """Remembers the goals of all stored transitions, and draws hindsight goals.

    Each transition gets a serial number: 0, 1, 2 and so on, in the order of writing. A
    round-robin buffer overwrites its oldest rows first. So it always holds the newest
    transitions, and for each of them all later steps of the same trajectory.

    Three arrays lead from a serial number to goals. An example with a ring of 10
    entries:

        serial number 17
            `_ring[17 % 10]` is (trajectory 3, step 5)
                `_trajectories[3]["offset"]` is 40
                    `_goals[40 + 5]` holds the goals of this transition
                    `_goals[40 + 6]` holds the goals of the trajectory's next step

    Each trajectory has a block of successive rows in `_goals`. If the block is full,
    the remembered goals move to another block.

    A new transition continues the open trajectory with the same id. (A trajectory is
    open until one of its transitions is done.) But a second collector may reuse an id
    that the first one left open. The memory detects this by the root goal, which is the
    achieved goal before a step. Within a trajectory, the root goal equals the goal that
    the previous step achieved. If the two differ, a new trajectory begins. In some data
    the two differ everywhere, so the memory checks them only after it has seen them
    equal once.
    """

    def __init__(self) -> None:
        # The buffer whose transitions are remembered.
        self.buffer: weakref.ref[ReplayBuffer] | None = None
        self.count = 0  # transitions written so far: the next serial number
        self.oldest = 0  # serial number of the oldest remembered transition
        # Open trajectories by id: trajectory number, next step, last achieved goal.
        self._open: dict[int, tuple[int, int, bytes]] = {}
        self._checks_root_goals = False
        self._ring = np.zeros(0, _POSITION)  # index: serial number % ring size
        self._trajectories = np.zeros(64, _TRAJECTORY)  # index: trajectory number
        self._free_numbers = [*range(64)]  # trajectory numbers that are not in use
        # Column 0 holds achieved goals. Column 1 holds desired goals, if a strategy
        # draws from them. The shape is (rows, 1 or 2, *goal).
        self._goals: Goals = np.zeros((0, 1), dtype=np.float32)
        self._num_block_rows = 0  # rows of `_goals` in blocks, also in free ones
        self._free_blocks: dict[int, list[int]] = {}  # block size -> first rows

    def write(
        self,
        ids: Integers,
        done: NDArray[np.bool_],
        root_goals: Goals | None,
        goals: list[Goals],
        stored: int,
    ) -> Integers:
        """Remembers transitions that are about to be stored.

        Args:
            ids: Ids of the trajectories, or numbers of the environments, (n,).
            done: Whether the transition ends its trajectory, (n,).
            root_goals: Achieved goals before the transitions, if the data have them.
            goals: Achieved goals after the transitions and, if "desired" is among the
                strategies, their desired goals.
            stored: Number of transitions in the buffer before these are written.

        Returns:
            Serial numbers of the transitions, (n,).
        """
        if not self.count:
            shape = (0, len(goals), *goals[0].shape[1:])
            self._goals = np.zeros(shape, np.result_type(*goals))
        self._make_room(len(ids), stored)
        serials = np.arange(self.count, self.count + len(ids))
        numbers, steps = self._assign_positions(ids, done, root_goals, goals[0])
        ring_indices = serials % len(self._ring)
        self._ring["trajectory"][ring_indices] = numbers
        self._ring["step"][ring_indices] = steps

        # If a trajectory occurs several times, numpy keeps the last value.
        self._trajectories["end"][numbers] = steps + 1
        exceeds_block = steps >= self._trajectories["limit"].take(numbers)
        for number in set(numbers[exceeds_block].tolist()):
            self._move_block(number)
        rows = self._trajectories["offset"].take(numbers) + steps
        for column, values in enumerate(goals):
            self._goals[rows, column] = values
        self.count += len(ids)
        return serials

    def _assign_positions(
        self,
        ids: Integers,
        done: NDArray[np.bool_],
        root_goals: Goals | None,
        achieved_goals: Goals,
    ) -> tuple[Integers, Integers]:
        """Returns trajectory numbers and steps of new transitions, (n,) each."""
        if root_goals is None:  # empty bytes stand for unknown goals
            roots = achieved = [b""] * len(ids)
        else:
            roots, achieved = _to_bytes(root_goals), _to_bytes(achieved_goals)
        numbers, steps = [], []
        transitions = zip(ids.tolist(), done.tolist(), roots, achieved, strict=True)
        for trajectory_id, is_done, root, goal in transitions:
            number, step, last_goal = self._open.pop(trajectory_id, (-1, 0, b""))
            if root == last_goal != b"":
                self._checks_root_goals = True
            if number < 0 or (self._checks_root_goals and root != last_goal):
                number, step = self._take_number(), 0
            if not is_done:
                self._open[trajectory_id] = number, step + 1, goal
            numbers.append(number)
            steps.append(step)
        return np.array(numbers, dtype=np.int32), np.array(steps, dtype=np.int32)

    def _take_number(self) -> int:
        """Returns a trajectory number that is not in use."""
        if not self._free_numbers:
            size = len(self._trajectories)
            self._trajectories = _grow(self._trajectories, 2 * size)
            self._free_numbers = [*range(size, len(self._trajectories))]
        return self._free_numbers.pop()

    def _move_block(self, number: int) -> None:
        """Moves a trajectory's goals to a block that has room for all its steps."""
        first, end, offset, limit, _ = self._trajectories[number].tolist()
        goals = self._goals[offset + first : offset + limit].copy()
        self._free_block(number)
        # Reserve an eighth more than is needed now, so that the block is not full again
        # at once. Sizes are powers of two, so that freed blocks fit other trajectories.
        size = 1 << max(_MIN_BLOCK - 1, 9 * (end - first) // 8).bit_length()
        free_blocks = self._free_blocks.setdefault(size, [])
        if not free_blocks:
            free_blocks.append(self._num_block_rows)
            self._num_block_rows += size
            self._goals = _grow(self._goals, self._num_block_rows)
        block = free_blocks.pop()
        self._goals[block : block + len(goals)] = goals
        self._trajectories[number] = first, end, block - first, first + size, block

    def _free_block(self, number: int) -> None:
        """Frees the block of a trajectory, if it has one."""
        _, _, offset, limit, block = self._trajectories[number].tolist()
        if limit:
            size = offset + limit - block  # `offset + limit` is the row after the block
            self._free_blocks[size].append(block)

    def _make_room(self, n: int, stored: int) -> None:
        """Makes room in the ring for n more transitions."""
        size, end = len(self._ring), self.count + n
        if end - self.oldest <= size:
            return
        self.forget(self.count - stored)
        needed = end - self.oldest + size // 64  # some spare room, to grow rarely
        if needed > size:
            serials = np.arange(self.oldest, self.count)
            positions = self._ring.take(serials % size)
            self._ring = _grow(self._ring, needed)
            self._ring[serials % len(self._ring)] = positions

    def forget(self, oldest: int) -> None:
        """Forgets overwritten transitions: those with serial numbers below `oldest`."""
        if oldest <= self.oldest:
            return
        numbers, steps = self.find(np.arange(self.oldest, oldest))
        first, end = self._trajectories["first"], self._trajectories["end"]
        first[numbers] = steps + 1
        forgotten = set(numbers[first[numbers] == end[numbers]].tolist())
        for number in forgotten:
            self._free_block(number)
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

    def get_achieved(self, serials: Integers) -> Goals:
        """Returns the goals that transitions achieved, (n, *goal)."""
        numbers, steps = self.find(serials)
        rows = self._trajectories["offset"].take(numbers) + steps
        achieved: Goals = self._goals[rows, 0]
        return achieved

    def end_trajectories(self) -> None:
        """Ends all trajectories: the next row of each id begins a new trajectory."""
        self._open.clear()

    def draw(
        self, serials: Integers, mixture: Mixture, generator: Generator | None
    ) -> Goals:
        """Draws a hindsight goal for each transition.

        Args:
            serials: Serial numbers of the transitions, (n,).
            mixture: Strategies that choose where each goal comes from.
            generator: Generator of the random draws; None means torch's global one.

        Returns:
            The goals, (n, *goal).
        """
        goals = np.empty((len(serials), *self._goals.shape[2:]), self._goals.dtype)
        for strategy, rows in mixture.split(len(serials), generator):
            # Choose trajectories: each row's own, or those of random transitions.
            sources = serials[rows]
            uses_all_trajectories = strategy in (RANDOM, DESIRED)
            if uses_all_trajectories:
                end = np.full(len(sources), self.count)
                sources = draw_integers(self.oldest, end, generator)
            numbers, steps = self.find(sources)
            trajectories = self._trajectories.take(numbers)
            # Choose steps in these trajectories. For random transitions, `find` has
            # already returned the steps.
            if not uses_all_trajectories:
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
        """Returns a copy of all contents, as tensors, numbers, strings, containers.

        The keys never change, so that newer versions can read older files.
        """
        ring = self._ring.view(np.int32).reshape(-1, 2)
        trajectories = self._trajectories.view(np.int32).reshape(-1, 5)
        return {
            "count": self.count,
            "freed": self.oldest,
            "open": {
                trajectory_id: (number, step, goal.hex())
                for trajectory_id, (number, step, goal) in self._open.items()
            },
            "_links": self._checks_root_goals,
            "_ring": torch.from_numpy(ring.copy()),
            "_table": torch.from_numpy(trajectories.copy()),
            "_unused": self._free_numbers.copy(),
            "_goals": torch.from_numpy(self._goals.copy()),
            "_used": self._num_block_rows,
            "_free_regions": copy.deepcopy(self._free_blocks),
        }

    def load(self, state: dict[str, Any], *, needs_desired: bool) -> None:
        """Restores a copy of the contents that `state` returned.

        Args:
            state: The contents.
            needs_desired: Whether a strategy draws from the desired goals.

        Raises:
            ValueError: Desired goals are needed, but the contents lack them.
        """
        num_columns = 2 if needs_desired else 1
        if state["count"] and state["_goals"].shape[1] < num_columns:
            raise ValueError(
                "the saved transitions cannot be sampled with the strategy "
                f"{DESIRED!r}: the desired goals were not saved, because the strategy "
                f"at that time drew none; load them with a strategy without "
                f"{DESIRED!r}, or pass the stored rows through prepare() of a new "
                "transform"
            )

        def to_array(tensor: Tensor) -> NDArray[Any]:
            return tensor.numpy(force=True).copy()

        self.count, self.oldest = state["count"], state["freed"]
        self._checks_root_goals = state["_links"]
        # The next rows may come from a new collector that reuses the ids. Only the
        # check of root goals would detect this. Without it, end all trajectories.
        self._open = {
            trajectory_id: (number, step, bytes.fromhex(goal))
            for trajectory_id, (number, step, goal) in state["open"].items()
            if self._checks_root_goals
        }
        self._ring = to_array(state["_ring"]).view(_POSITION).ravel()
        self._trajectories = to_array(state["_table"]).view(_TRAJECTORY).ravel()
        self._free_numbers = [*state["_unused"]]
        # Drop saved desired goals that no strategy draws, because they would not be
        # saved for later transitions.
        self._goals = to_array(state["_goals"][:, :num_columns])
        self._num_block_rows = state["_used"]
        self._free_blocks = copy.deepcopy(state["_free_regions"])

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "buffer": None}  # a weak reference cannot be pickled


def _to_bytes(goals: Goals) -> list[bytes]:
    """Returns the bytes of each goal of (n, *goal). Python compares bytes fast."""
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
