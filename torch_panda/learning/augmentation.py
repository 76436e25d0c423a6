"""Data augmentation: mirrors transitions and shifts them over the table.

The physics of the scene is nearly the same after a mirroring or a shift, so the
augmented transitions are nearly as realistic as the observed ones. Mirroring follows
Invariant Transform Experience Replay (arXiv 1909.10707).
"""

import torch
from torch import Tensor

from torch_panda.learning.geometry import Geometry
from torch_panda.learning.hyperparameters import AugmentationKind
from torch_panda.learning.transitions import Transitions

SHIFT = 0.15  # largest shift along x and y [m]


def augment(
    rows: Transitions, geometry: Geometry | None, mode: AugmentationKind
) -> Transitions:
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


def mirror(rows: Transitions, geometry: Geometry) -> Transitions:
    """Mirror every second row."""
    assert geometry.action is not None

    def mirrored(values: Tensor, factors: tuple[float, ...]) -> Tensor:
        values = values.clone()
        values[::2] *= values.new_tensor(factors)
        return values

    return rows._replace(
        observation=mirrored(rows.observation, geometry.observation),
        goal=mirrored(rows.goal, geometry.goal),
        action=mirrored(rows.action, geometry.action),
        next_observation=mirrored(rows.next_observation, geometry.observation),
    )


def shift(rows: Transitions, geometry: Geometry, distance: float) -> Transitions:
    """Shift about half of the rows by up to ``distance`` along x and y [m].

    All positions in a row move by the same offset, as if the robot's base stood
    elsewhere.
    """
    offset = torch.empty_like(rows.goal[:, :2]).uniform_(-distance, distance)
    offset *= torch.rand_like(offset[:, :1]) < 0.5

    def shifted(values: Tensor, starts: tuple[int, ...]) -> Tensor:
        values = values.clone()
        for start in starts:
            values[:, start : start + 2] += offset
        return values

    return rows._replace(
        observation=shifted(rows.observation, geometry.positions),
        goal=shifted(rows.goal, geometry.goal_positions),
        next_observation=shifted(rows.next_observation, geometry.positions),
    )
