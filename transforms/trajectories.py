"""Which trajectory every transition belongs to."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

Integers = NDArray[np.integer[Any]]
Goals = NDArray[Any]  # (n, *goal)
# Of transitions: ids, whether they are done, what they achieved and began with.
Columns = tuple[Integers, NDArray[np.bool_], Goals, Goals | None]


class TrajectoryTracker:
    """Follows trajectories from batch to batch; they are named by their first serial.

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
    ) -> tuple[Integers, Integers, Integers]:
        """Returns rows by trajectory, (n,), lengths and names of their runs, (m,)."""
        if self._has_roots != (root is not None):
            self.open.clear()
            self._has_roots = root is not None
        order = ids.argsort(kind="stable")
        names, ends = ids[order], done[order]
        is_head = np.ones(len(order), dtype=bool)  # the first row of its id
        is_head[1:] = names[1:] != names[:-1]
        known = np.full(len(order), -1)
        known[is_head] = [self.open.pop(i, -1) for i in names[is_head].tolist()]
        begins = known < 0
        begins[1:] &= is_head[1:] | ends[:-1]
        if root is not None:
            inner = (~begins & ~is_head).nonzero()[0]
            resumed = (known >= 0).nonzero()[0]
            before = achieved[order[inner - 1]], last_achieved(known[resumed])
            places = np.concatenate([inner, resumed])
            same = np.concatenate(before) == root[order[places]]
            follows = same.reshape(len(places), root[:1].size).all(1)
            self._links = self._links or bool(follows.any())
            begins[places[~follows]] = self._links
        start = (begins | is_head).nonzero()[0]
        length = np.diff(start, append=len(order))
        trajectory = np.where(begins, self.count + order, known)[start]
        self.count += len(order)
        runs = (names[start], trajectory, ends[start + length - 1])
        for name, t, end in zip(*(x.tolist() for x in runs), strict=True):
            self.open[name] = t
            if end:
                del self.open[name]
        return order, length, trajectory

    def load(self, state: dict[str, Any]) -> None:
        """Takes another tracker's attributes."""
        vars(self).update(state)
        if not self._links:  # nothing would show that an id is used again
            self.open.clear()


def time_first(value: Tensor, batch_dims: int) -> Any:  # noqa: ANN401 (of any type)
    """Flattens [*batch, time, ...] to (time * batch, ...), as storages fill up."""
    if batch_dims > 1:
        value = value.movedim(batch_dims - 1, 0).flatten(0, batch_dims - 1)
    return value.cpu().numpy()


def ids_of(batch: TensorDictBase, key: NestedKey, single_env: bool) -> Integers:
    """Returns ids, or environments, of [*batch, time] in `time_first` order, (n,).

    Raises:
        ValueError: the data do not tell which trajectory a transition belongs to.
    """
    ids = batch.get(key, None)
    shape = tuple(batch.shape)
    if ids is not None:
        if ids.numel() != batch.numel():
            got = tuple(ids.shape)
            raise ValueError(f"expected ids {shape} at {key!r}, got {got}.")
        numbers: Integers = time_first(ids.reshape(batch.shape), batch.ndim)
        return numbers
    if batch.ndim < 2 and not single_env:
        raise ValueError(
            f"cannot tell trajectories apart in a batch {shape} without ids at {key!r}:"
            " keep the collector's ids, name others with trajectory_key=, extend with "
            "[num_envs, time], or pass single_env=True for steps of one environment."
        )
    return np.tile(np.arange(batch.shape[:-1].numel()), batch.shape[-1])
