"""Data augmentation: mirrors transitions and shifts them over the table.

The physics of the scene is nearly the same after a mirroring or a shift, so the
augmented transitions are nearly as realistic as the observed ones. Mirroring follows
Invariant Transform Experience Replay (arXiv 1909.10707).
"""

import functools

import torch
from torch import Tensor

from torch_panda.learning.agents.batch import Batch
from torch_panda.learning.agents.hyperparameters import AugmentationKind
from torch_panda.learning.environments.geometry import Geometry

SHIFT = 0.15  # largest shift along x and y [m]


def augment(rows: Batch, geometry: Geometry | None, mode: AugmentationKind) -> Batch:
    """Return an augmented copy of a batch.

    Args:
        rows: The batch.
        geometry: Layout of observations, goals and actions; None only without
            augmentation.
        mode: "none", "mirror", or "mirror-shift" for both augmentations.
    """
    if mode == "none":
        return rows
    assert geometry is not None
    rows = mirror(rows, geometry)
    return shift(rows, geometry, SHIFT) if mode == "mirror-shift" else rows


def mirror(rows: Batch, geometry: Geometry) -> Batch:
    """Mirror every second row."""
    assert geometry.action is not None

    def mirrored(values: Tensor, factors: tuple[float, ...]) -> Tensor:
        values = values.clone()
        values[::2] *= _to_tensor(factors, values.device)
        return values

    return rows._replace(
        s=mirrored(rows.s, geometry.observation),
        a=mirrored(rows.a, geometry.action),
        s_next=mirrored(rows.s_next, geometry.observation),
        g=mirrored(rows.g, geometry.goal),
    )


@functools.cache
def _to_tensor(factors: tuple[float, ...], device: torch.device) -> Tensor:
    """Make a tensor, once for each device: CUDA graphs do not copy from the CPU."""
    return torch.tensor(factors, device=device)


def shift(rows: Batch, geometry: Geometry, distance: float) -> Batch:
    """Shift about half of the rows by up to ``distance`` along x and y [m].

    All positions in a row move by the same offset, as if the robot's base stood
    elsewhere.
    """
    offset = rows.s.new_empty(len(rows.s), 2).uniform_(-distance, distance)
    offset *= torch.rand_like(offset[:, :1]) < 0.5

    def shifted(values: Tensor, starts: tuple[int, ...]) -> Tensor:
        values = values.clone()
        for start in starts:
            values[:, start : start + 2] += offset
        return values

    return rows._replace(
        s=shifted(rows.s, geometry.positions),
        s_next=shifted(rows.s_next, geometry.positions),
        g=shifted(rows.g, geometry.goal_positions),
    )
