"""Which trajectory every transition of a batch belongs to."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

Integers = NDArray[np.integer[Any]]

TRAJECTORY_KEY = ("collector", "traj_ids")


class Runs(NamedTuple):
    """Consecutive steps of one trajectory each, found in a batch sorted by stream.

    Attributes:
        start: first row of every run, shape (m,), int64.
        length: number of rows of every run, shape (m,), int64.
        stream: the stream of every run, m numbers.
        ended: whether the run's last row ends its trajectory, shape (m,), bool.
    """

    start: Integers
    length: Integers
    stream: list[int]
    ended: NDArray[np.bool_]


def split_runs(stream: Integers, done: NDArray[np.bool_]) -> Runs:
    """Cuts a sorted batch into runs: where the stream changes, and after every done.

    Args:
        stream: what the transition comes from (a trajectory's or an environment's
            number), shape (n,), sorted. Rows of one stream are in time order.
        done: whether the transition ends its trajectory, shape (n,).
    """
    last = done.copy()
    last[-1] = True
    last[:-1] |= stream[1:] != stream[:-1]
    ends = last.nonzero()[0]
    start = np.zeros_like(ends)
    start[1:] = ends[:-1] + 1
    return Runs(start, ends + 1 - start, stream[ends].tolist(), done[ends])


def find_strays(
    order: Integers, before: Integers, achieved: Tensor, root: Tensor
) -> Integers:
    """Finds the rows after which the next one begins elsewhere than they got to.

    Args:
        order: a batch's rows, sorted, (n,).
        before: places in `order` of the rows to look at, (m,).
        achieved: what every row achieved, (n, *goal).
        root: what was achieved before it, (n, *goal).

    Returns:
        Those of the places `before`, (k,).
    """
    rows, following = (
        torch.from_numpy(order[x]).to(root.device) for x in (before, before + 1)
    )
    return before[differ(achieved[rows], root[following])]


def differ(a: Tensor, b: Tensor) -> Integers:
    """Returns the places, (m,), where goals, (n, *goal) each, are not the same."""
    if torch.equal(a, b):  # as a rule, and much faster
        return np.zeros(0, dtype=np.int64)
    return (a != b).reshape(len(a), -1).any(1).cpu().numpy().nonzero()[0]


def time_first(value: Tensor, batch_dims: int) -> Tensor:
    """Flattens [*batch, time, ...] to (time * batch, ...), time slowest.

    That is the order in which a multi-dimensional storage fills up. One-dimensional
    data keep their order, a single transition becomes one row.
    """
    if batch_dims == 0:
        return value.unsqueeze(0)
    if batch_dims == 1:
        return value
    return value.movedim(batch_dims - 1, 0).flatten(0, batch_dims - 1)


def time_last(value: Tensor, shape: torch.Size) -> Tensor:
    """Undoes `time_first` for a batch of that shape: (n, ...) to (*shape, ...)."""
    if not shape:
        return value.squeeze(0)
    if len(shape) == 1:
        return value
    value = value.view(shape[-1], *shape[:-1], *value.shape[1:])
    return value.movedim(0, len(shape) - 1)


def streams_of(batch: TensorDictBase, key: NestedKey, single_env: bool) -> Tensor:
    """Returns the stream of every transition, in the order of `time_first`, (n,).

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
        if ids.ndim == 1 and ids.shape == batch.shape:
            return ids
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
    steps = batch.shape[-1] if batch.ndim else 1
    return torch.arange(envs, device="cpu").repeat(steps)
