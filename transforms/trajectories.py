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
    """Consecutive steps of one trajectory each, found in a batch of n transitions.

    Attributes:
        order: the batch's rows sorted by stream, time order kept, shape (n,), int64.
        length: number of sorted rows of every run, shape (m,), int64.
        stream: the stream of every run, m numbers.
        ended: whether the run's last row ends its trajectory, m flags.
    """

    order: Integers
    length: Integers
    stream: list[int]
    ended: list[bool]


def split_runs(stream: Integers, done: NDArray[np.bool_]) -> Runs:
    """Cuts a batch into runs: where the stream changes, and after every done.

    Args:
        stream: what the transition comes from (a trajectory's or an environment's
            number), shape (n,). Rows of one stream are in time order.
        done: whether the transition ends its trajectory, shape (n,).
    """
    order = stream.argsort(kind="stable")
    stream, done = stream[order], done[order]
    last = done.copy()
    last[-1] = True
    last[:-1] |= stream[1:] != stream[:-1]
    ends = last.nonzero()[0]
    length = ends + 1
    length[1:] -= length[:-1]  # numpy takes care of the overlap
    return Runs(order, length, stream[ends].tolist(), done[ends].tolist())


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
    return torch.arange(envs, device=batch.device).repeat(steps)
