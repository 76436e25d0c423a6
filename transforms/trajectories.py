"""Which trajectory every transition belongs to."""

from __future__ import annotations

from collections.abc import Callable
from itertools import compress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, bfloat16

Integers = NDArray[np.integer[Any]]
Goals = NDArray[Any]  # (n, *goal)
# Of transitions, n each: ids, whether they are done, goals they achieved and, unless
# the data do not tell, had achieved before.
Columns = tuple[Integers, NDArray[np.bool_], Goals, Goals | None]


class Runs(NamedTuple):
    """Rows of a batch, (n,), put in order: m runs, each of one trajectory."""

    order: Integers  # (n,), the rows run by run
    length: Integers  # (m,), of the runs
    trajectory: Integers  # (m,), which they belong to; -1 for a new one
    name: Integers  # (m,), their ids
    is_open: NDArray[np.bool_]  # (m,), whether the next batch may go on with them


class TrajectoryTracker:
    """Follows trajectories from batch to batch.

    A row goes on with the trajectory of the row of its id before it, unless that was
    done, or got to another goal than this row begins with (as ids begin anew with every
    collector). If no row ever begins where the one before got to, the ids decide.
    """

    def __init__(self) -> None:
        self.count = 0  # transitions so far: serial of the next one
        self.open: dict[int, int] = {}  # id -> trajectory that may go on
        self._has_roots = False
        self._links = False  # whether a row ever began with the goal before it

    def follow(
        self,
        ids: Integers,
        done: NDArray[np.bool_],
        achieved: Goals,
        root: Goals | None,
        last_achieved: Callable[[Integers], Goals],
    ) -> Runs:
        """Puts the rows of a batch, n, in order; `keep` then remembers the runs.

        Args:
            ids: of trajectories or environments, (n,).
            done: whether a trajectory ends, (n,).
            achieved: the goals that were achieved, (n, *goal).
            root: those that had been achieved before, if the data tell.
            last_achieved: what the last rows of trajectories, (m,), achieved.
        """
        if self._has_roots != (root is not None):
            self.open.clear()
            self._has_roots = root is not None
        order, n = ids.argsort(kind="stable"), len(ids)
        names, ends = ids[order], done[order]
        is_head = np.empty(n + 1, dtype=bool)  # the first row of its id, and the end
        is_head[0] = is_head[n] = True
        is_head[1:n] = names[1:] != names[:-1]
        heads = is_head[:n].nonzero()[0]
        known = np.empty(n, dtype=np.int64)  # the trajectory before an id's first row
        known[heads] = [self.open.pop(i, -1) for i in names[heads].tolist()]
        begins = np.empty(n, dtype=bool)
        begins[1:] = ends[:-1]
        begins[heads] = known[heads] < 0
        if root is not None:
            before = np.empty_like(achieved)
            before[1:] = achieved.take(order[:-1], axis=0)
            resumed = heads[~begins[heads]]
            if len(resumed):
                before[resumed] = last_achieved(known[resumed])
            same = before.reshape(n, -1) == root.take(order, axis=0).reshape(n, -1)
            follows = same.all(1) & ~begins
            self._links = self._links or bool(follows.any())
            begins = ~follows if self._links else begins
        start = (begins | is_head[:n]).nonzero()[0]
        trajectory = known[start]
        trajectory[begins[start]] = -1
        end = np.empty_like(start)
        end[:-1], end[-1] = start[1:], n
        self.count += n
        is_open = is_head[end] & ~ends[end - 1]
        return Runs(order, end - start, trajectory, names[start], is_open)

    def keep(self, runs: Runs) -> None:
        """Remembers which trajectories may go on, now that all of them have names."""
        pairs = zip(runs.name.tolist(), runs.trajectory.tolist(), strict=True)
        self.open.update(compress(pairs, runs.is_open.tolist()))

    def forget(self, trajectories: set[int]) -> None:
        """Ends trajectories that have been overwritten."""
        if not trajectories.isdisjoint(self.open.values()):
            pairs = self.open.items()
            self.open = {i: t for i, t in pairs if t not in trajectories}

    def load(self, state: dict[str, Any]) -> None:
        """Takes another tracker's attributes."""
        vars(self).update(state)
        if not self._links:  # nothing would show that an id is used again
            self.open.clear()


def time_first(value: Tensor, batch_dims: int) -> Any:  # noqa: ANN401 (of any type)
    """Flattens [*batch, time, ...] to (time * batch, ...), as storages fill up.

    Raises:
        ValueError: numpy does not know the type, of goals of bfloat16.
    """
    if value.dtype is bfloat16:
        raise ValueError("hindsight cannot hold goals of bfloat16: use float32 ones.")
    if batch_dims > 1:
        value = value.movedim(batch_dims - 1, 0).flatten(0, batch_dims - 1)
    return value.numpy(force=True)


def ids_of(batch: TensorDictBase, key: NestedKey, single_env: bool) -> Integers:
    """Returns ids, or environments, of [*batch, time] in `time_first` order, (n,).

    Raises:
        ValueError: the data do not tell which trajectory a transition belongs to.
    """
    ids = batch.get(key, None)
    shape = tuple(batch.shape)
    if ids is not None:
        if ids.numel() != batch.numel():
            raise ValueError(
                f"the ids of trajectories at {key!r} must have the shape of the batch, "
                f"{shape}, got {tuple(ids.shape)}."
            )
        numbers: Integers = time_first(ids.reshape(shape), len(shape))
        return numbers
    if batch.ndim < 2 and not single_env:
        raise ValueError(
            f"cannot tell trajectories apart in a batch {shape} without ids at {key!r}:"
            " keep the collector's ids, name others with trajectory_key=, extend with "
            "[num_envs, time], or pass single_env=True for steps of one environment."
        )
    return np.tile(np.arange(batch.shape[:-1].numel()), batch.shape[-1])
