"""Hindsight goals at sample time, as a transform of a replay buffer."""

from __future__ import annotations

import threading
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import NestedKey, TensorDictBase

from torch_panda.transforms.buffer_only import BufferTransform
from torch_panda.transforms.memory import GoalMemory
from torch_panda.transforms.rewrite import GoalFunction
from torch_panda.transforms.strategies import LOOKING_AHEAD, Shares, Strategy
from torch_panda.transforms.trajectories import (
    TRAJECTORY_KEY,
    Integers,
    streams_of,
    time_first,
    time_last,
)

SERIAL_KEY = "hindsight_serial"


class HindsightRelabel(BufferTransform):
    """Gives sampled transitions goals that their trajectory achieved later.

    Hindsight experience replay (Andrychowicz et al. 2017, arXiv 1707.01495) for a
    replay buffer of any layout: on `extend` the transform notes to which trajectory
    and step every transition belongs and what it achieved; on `sample` it relabels a
    random `her_ratio` of the rows. The others come out as they were stored.

    A trajectory goes on in a later `extend` where a row of its id begins at the goal
    that was achieved last. If the data lack the root achieved goal, or it is never
    what the step before achieved, the id alone decides: call `end_trajectories` before
    data of a new collector, whose ids begin anew. Loading a saved buffer does so.

    =====================  ====  ====  ====  ====  ====
    k (goals a transition)    1     2     4     8    16
    her_ratio = k / (k+1)   0.5  0.67   0.8  0.89  0.94
    =====================  ====  ====  ====  ====  ====

    Args:
        reward_fn: the environment's reward, called once for all the relabelled rows,
            on the batch's device: (achieved_goal, desired_goal), each (n, *goal), to
            (n, 1). A row's reward may depend on that row only.

    Keyword Args:
        her_ratio: share of the rows that are relabelled, in [0, 1].
        strategy: where the goal is from: "future" (this step or a later one of the
            same episode), "final" (its last step), "episode" (any of its steps),
            "random" (any stored transition), or a function
            `(step, first, end, generator) -> goal step`, see `strategies`. It is what
            the step led to, ("next", achieved_goal), of what is stored of the episode.
        goal_key: the desired goal, rewritten in the root and under "next".
        achieved_goal_key: the achieved goal, read under "next" and, if there, in the
            root.
        reward_key: the reward.
        terminated_fn: maps as `reward_fn` does to (n, 1) bool, for tasks that end on
            success: also ("next", "terminated") and ("next", "done") are rewritten.
            A `SliceSampler` puts the stored flags back, unless truncated_key=None.
        trajectory_key: ids that tell trajectories apart. Data without them are taken
            for [*batch, time], one environment a row, in the same order every time.
        single_env: takes 1-d data without ids, and those of `add`, for consecutive
            steps of one environment.
        unit: "row" draws a goal a row. "slice" gives all the rows of a slice (rows that
            follow each other in the batch and in time) one goal, drawn for its last
            row: for recurrent and n-step learners on a `SliceSampler`.
        capacity: transitions that the buffer holds. By default it is found out from
            the samples, and needed only if the rows carry no "index", as in a plain
            `ReplayBuffer`; then call `empty` after emptying the buffer, too.
        seed: seeds a generator of its own. By default torch's is used.

    Raises:
        ValueError: an argument is out of range; the data do not tell which trajectory a
            transition belongs to; a function returned the wrong shape; the transform
            is put into an environment.
        KeyError: the data lack an entry that is needed; what is sampled was stored
            before the transform was in the buffer.
        RuntimeError: the buffer cannot be followed: it is not written round-robin,
            shared between processes, or combined with `MultiStepTransform`.

    Example:
        >>> rb = TensorDictReplayBuffer(
        ...     storage=LazyTensorStorage(1_000_000),
        ...     transform=HindsightRelabel(env.compute_reward, her_ratio=0.8),
        ...     batch_size=256,
        ... )
    """

    def __init__(
        self,
        reward_fn: GoalFunction,
        *,
        her_ratio: float = 0.8,
        strategy: str | Strategy = "future",
        goal_key: NestedKey = "desired_goal",
        achieved_goal_key: NestedKey = "achieved_goal",
        reward_key: NestedKey = ("next", "reward"),
        terminated_fn: GoalFunction | None = None,
        trajectory_key: NestedKey = TRAJECTORY_KEY,
        single_env: bool = False,
        unit: Literal["row", "slice"] = "row",
        capacity: int | None = None,
        seed: int | None = None,
    ) -> None:
        super().__init__(
            reward_fn,
            strategy=strategy,
            goal_key=goal_key,
            achieved_goal_key=achieved_goal_key,
            reward_key=reward_key,
            terminated_fn=terminated_fn,
            trajectory_key=trajectory_key,
            single_env=single_env,
            seed=seed,
        )
        if not 0 <= her_ratio <= 1:
            raise ValueError(f"her_ratio must be within [0, 1], got {her_ratio}.")
        if unit not in ("row", "slice"):
            raise ValueError(f'unit must be "row" or "slice", got {unit!r}.')
        if capacity is not None and not (
            capacity >= 1 and float(capacity).is_integer()
        ):
            raise ValueError(f"capacity must be a positive integer, got {capacity}.")
        self.her_ratio = her_ratio
        self.unit = unit
        self._memory = GoalMemory(capacity)
        self._lock = threading.Lock()  # a prefetching buffer samples in threads

    # -- a replay buffer's two calls --------------------------------------------------

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Notes the transitions that are about to be stored."""
        self._check_chain()
        shape = tensordict.batch_size
        with self._lock:
            achieved = tensordict.get(self._rewriter.next_achieved_key, None)
            done = tensordict.get(("next", "done"), None)
            if self._memory.head == 0 or achieved is None or done is None:
                self._rewriter.check(tensordict)
            root = tensordict.get(self._rewriter.achieved_goal_key, None)
            serial = self._memory.write(
                streams_of(tensordict, self.trajectory_key, self.single_env),
                time_first(done.reshape(shape), len(shape)),
                time_first(achieved, len(shape)),
                None if root is None else time_first(root, len(shape)),
                unit=shape[:-1].numel(),
            )
        return tensordict.set(SERIAL_KEY, time_last(serial, shape))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Relabels rows that a buffer has sampled."""
        tag = tensordict.get(SERIAL_KEY, None)
        if tag is None:
            raise KeyError(
                "the sampled rows were not noted by HindsightRelabel, which does so on "
                "extend: it must be in the buffer before the first one."
            )
        serial = tag.cpu().numpy().reshape(-1)
        with self._lock:
            floor = self._floor(serial, tensordict)
            choose = self._choose_rows if self.unit == "row" else self._choose_slices
            rows, last, share, place = choose(serial)
            if not len(rows):
                return tensordict.exclude(SERIAL_KEY)
            goals = self._memory.draw(
                last, self.strategy, share, floor, self._generator
            )
        if place is not None:
            goals = goals[place]
        device = tag.device
        relabelled = self._rewriter.rewrite(
            tensordict, torch.from_numpy(rows).to(device), goals.to(device)
        )
        return relabelled.del_(SERIAL_KEY)

    def _floor(self, serial: Integers, tensordict: TensorDictBase) -> int:
        """Returns the serial from which on goals may be drawn."""
        memory = self._memory
        if memory.capacity is not None and self.strategy in LOOKING_AHEAD:
            return memory.floor  # these strategies need no other
        index = tensordict.get("index", None)
        if index is not None:
            return memory.observe(serial, index.reshape(-1).cpu().numpy())
        if memory.capacity is None:
            raise RuntimeError(
                'the sampled rows have no "index": use a TensorDictReplayBuffer, or '
                "pass capacity=, the number of transitions the buffer holds."
            )
        return memory.floor

    def _choose(self, number: int) -> tuple[NDArray[np.bool_], Shares]:
        """Chooses a random `her_ratio` of so many, and numbers to draw goals with."""
        # The generator is the CPU's, so that a seed means the same on every device.
        drawn = torch.rand(
            number, generator=self._generator, dtype=torch.float64, device="cpu"
        )
        share = drawn.numpy()
        # Those below the ratio are uniform up to it: no second draw is needed.
        return share < self.her_ratio, share / (self.her_ratio or 1)

    def _choose_rows(self, serial: Integers) -> tuple[Integers, Integers, Shares, None]:
        """Chooses rows (n,) of a batch; returns also serials and shares, (n,) each."""
        chosen, share = self._choose(len(serial))
        chosen &= serial >= self._memory.floor  # the others were overwritten since
        rows = chosen.nonzero()[0]
        return rows, serial[rows], share[rows], None

    def _choose_slices(
        self, serial: Integers
    ) -> tuple[Integers, Integers, Shares, Integers]:
        """Chooses slices of a batch.

        Returns:
            Their rows, (n,), serials of their last rows and shares, (slices,) each, and
            which of these slices every row is in, (n,).
        """
        floor = self._memory.floor
        trajectory, step = self._memory.find(serial.clip(floor))
        ahead = np.diff(step)
        # A padded slice repeats its last row: still the same slice.
        goes_on = (np.diff(trajectory) == 0) & ((ahead == 0) | (ahead == 1))
        last = np.append(~goes_on, True)
        ends = last.nonzero()[0]
        slices = last.cumsum() - last
        chosen, share = self._choose(len(ends))
        chosen[slices[serial < floor]] = False
        rows = chosen[slices].nonzero()[0]
        place = (chosen.cumsum() - 1)[slices[rows]]
        return rows, serial[ends[chosen]], share[chosen], place

    def end_trajectories(self) -> None:
        """Ends all trajectories; what is written next begins new ones."""
        with self._lock:
            self._memory.end_trajectories()

    def empty(self) -> None:
        """Forgets all transitions, as after the buffer's own `empty`.

        Buffers do not tell their transforms. Where the rows carry an "index" the next
        sample shows it, unless a multiple of the capacity had been written.
        """
        with self._lock:
            self._memory.clear()

    # -- what torchrl's machinery asks for --------------------------------------------

    def get_extra_state(self) -> dict[str, Any]:
        """Returns the memory and the generator, for `state_dict` and `dumps`."""
        with self._lock:
            return {
                "memory": self._memory.state(),
                "generator": self._generator_state(),
            }

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Takes what `get_extra_state` returned."""
        with self._lock:
            self._memory.load(state["memory"])
            self._load_generator(state["generator"])

    def __getstate__(self) -> dict[str, Any]:
        state = super().__getstate__()
        del state["_lock"]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._lock = threading.Lock()

    def __repr__(self) -> str:
        return (
            f"HindsightRelabel(her_ratio={self.her_ratio}, "
            f"strategy={self.strategy!r}, unit={self.unit!r})"
        )
