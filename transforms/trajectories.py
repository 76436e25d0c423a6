"""Which trajectory every transition belongs to."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

Integers = NDArray[np.integer[Any]]


class Runs(NamedTuple):
    """Consecutive steps of one trajectory each, found in a batch.

    Attributes:
        order: the batch's rows, sorted by run and within a run by time, (n,).
        start: place in `order` where every run begins, (m,).
        length: number of rows of every run, (m,).
        trajectory: the serial number of its trajectory's first transition, (m,).
    """

    order: Integers
    start: Integers
    length: Integers
    trajectory: Integers


class TrajectoryTracker:
    """Follows trajectories from batch to batch.

    A row goes on with the trajectory of the row of its id before it, unless that one
    was done, or had achieved another goal than this row begins with (ids begin anew
    with every collector). If no row ever begins with the goal achieved before it, or
    what it begins with is unknown, the ids alone decide.

    Attributes:
        count: transitions so far, which numbers them.
        open: id -> trajectory that may go on.
    """

    def __init__(self) -> None:
        self.count = 0
        self.open: dict[int, int] = {}
        self._has_roots = False
        self._links = False  # whether a row ever began with the goal before it

    def follow(
        self,
        ids: Tensor,
        done: Tensor,
        achieved: Tensor,
        root: Tensor | None,
        last_achieved: Callable[[list[int]], Tensor],
    ) -> Runs:
        """Finds the trajectories of a batch.

        Args:
            ids: id of every row's trajectory or environment, (n,). The rows of an id
                are in time order.
            done: whether the row ends its trajectory, (n,), bool.
            achieved: what the row achieved, (n, *goal).
            root: what had been achieved before it, (n, *goal), None if unknown.
            last_achieved: returns what trajectories achieved last, (k, *goal).
        """
        if self._has_roots != (root is not None):
            self.open.clear()
            self._has_roots = root is not None
        unsorted_ids = ids.cpu().numpy()
        order = unsorted_ids.argsort(kind="stable")
        names, ends = unsorted_ids[order], done.cpu().numpy()[order]
        is_head = np.ones(len(order), dtype=bool)  # the first row of its id
        is_head[1:] = names[1:] != names[:-1]
        known = np.full(len(order), -1)
        known[is_head] = [self.open.pop(i, -1) for i in names[is_head].tolist()]
        begins = known < 0
        begins[1:] &= is_head[1:] | ends[:-1]
        if root is not None:
            inner = (~begins & ~is_head).nonzero()[0]
            resumed = (known >= 0).nonzero()[0]
            places = np.concatenate([inner, resumed])
            before = achieved[torch.from_numpy(order[inner - 1])]
            if len(resumed):
                last = last_achieved(known[resumed].tolist())
                before = torch.cat([before, last.to(before)])
            after = root[torch.from_numpy(order[places])]
            follows = (before == after).flatten(1).all(1).cpu().numpy()
            self._links = self._links or bool(follows.any())
            if self._links:
                begins[places[~follows]] = True
        start = (begins | is_head).nonzero()[0]
        length = np.diff(start, append=len(order))
        trajectory = np.where(begins, self.count + order, known)[start]
        self.count += len(order)
        last_rows = start + length - 1
        for i, t, end in zip(names[start], trajectory, ends[last_rows], strict=True):
            self.open[int(i)] = int(t)
            if end:
                del self.open[int(i)]
        return Runs(order, start, length, trajectory)

    def state(self) -> dict[str, Any]:
        """Returns a copy of everything, as numbers and dicts."""
        return {**vars(self), "open": dict(self.open)}

    def load(self, state: dict[str, Any]) -> None:
        """Takes the state that another tracker returned."""
        vars(self).update(state, open=dict(state["open"]))
        if not self._links:  # nothing would show that an id is used again
            self.open.clear()


def time_first(value: Tensor, batch_dims: int) -> Tensor:
    """Flattens [*batch, time, ...] to (time * batch, ...), time slowest.

    That is the order in which a multi-dimensional storage fills up.
    """
    if batch_dims == 1:
        return value
    return value.movedim(batch_dims - 1, 0).flatten(0, batch_dims - 1)


def time_last(value: Tensor, shape: torch.Size) -> Tensor:
    """Undoes `time_first` for a batch of that shape: (n,) to (*shape)."""
    return value.view(shape[-1], *shape[:-1]).movedim(0, -1)


def ids_of(batch: TensorDictBase, key: NestedKey, single_env: bool) -> Tensor:
    """Returns the id of every transition's trajectory, in `time_first` order, (n,).

    Args:
        batch: transitions of shape [*batch, time], or flattened.
        key: where trajectory ids are; without them the leading dimensions number
            the environments and the last one is time.
        single_env: whether 1-d data without ids are one environment's steps.

    Raises:
        ValueError: the data do not tell which trajectory a transition belongs to.
    """
    ids = batch.get(key, None)
    if ids is not None:
        if ids.numel() != batch.numel():
            raise ValueError(
                f"expected one trajectory id a transition under {key!r}, got shape "
                f"{tuple(ids.shape)} for a batch of {tuple(batch.shape)}."
            )
        return time_first(ids.reshape(batch.shape), batch.ndim)
    if batch.ndim < 2 and not single_env:
        raise ValueError(
            f"cannot tell the trajectories of a batch of shape {tuple(batch.shape)} "
            f"apart: it has no ids under {key!r}. Keep the collector's ids, name "
            "another key with trajectory_key=, extend with [num_envs, time] data in "
            "a fixed order of environments, or pass single_env=True if the rows are "
            "consecutive steps of one environment."
        )
    envs = batch.shape[:-1].numel()
    return torch.arange(envs, device="cpu").repeat(batch.shape[-1])
