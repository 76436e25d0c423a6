"""What is read of transitions to follow them, as arrays of numpy."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, bfloat16

Integers = NDArray[np.integer[Any]]
Goals = NDArray[Any]  # (n, *goal)
# Of transitions, n each: ids, whether they are done, goals they achieved and, unless
# the data do not tell, had achieved before.
Columns = tuple[Integers, NDArray[np.bool_], Goals, Goals | None]


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
