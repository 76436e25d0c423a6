"""Data augmentation: transitions mirrored, moved over the table, objects exchanged.

Such transitions are as possible as those that were seen, nearly: see Invariant
Transform Experience Replay (arXiv 1909.10707) for mirrors.
"""

import torch
from torch import Tensor

from agents.geometry import Geometry
from agents.hyperparameters import AugmentationKind
from agents.transitions import Transitions

SHIFT = 0.15  # [m], at most, in x and y


class Augmentation:
    """Changes some rows of a batch.

    Args:
        geometry: of the task.
        kind: what to do.

    Raises:
        ValueError: the robot is not controlled by its end-effector, or there are no two
            objects to exchange.
    """

    def __init__(self, geometry: Geometry, kind: AugmentationKind) -> None:
        if kind != "none" and geometry.action is None:
            raise ValueError(
                f"augmentation {kind!r} is for end-effector control: with joint "
                "control pass --augmentation none"
            )
        if kind == "mirror-shift-swap" and len(geometry.goal_positions) != 2:
            raise ValueError(
                "augmentation 'mirror-shift-swap' is for tasks of two equal objects, "
                "such as Stack"
            )
        self.geometry, self.kind = geometry, kind

    def __call__(self, rows: Transitions) -> Transitions:
        """Augment a batch; what was given stays as it is."""
        if self.kind != "none":
            rows = mirror(rows, self.geometry)
        if self.kind.startswith("mirror-shift"):
            rows = shift(rows, self.geometry, SHIFT)
        if self.kind == "mirror-shift-swap":
            rows = swap(rows, self.geometry)
        return rows


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
    """Move half of the rows, at random, each by up to ``distance`` in x and y [m].

    Hand, objects and goals move together, as if the robot stood elsewhere.
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


def swap(rows: Transitions, geometry: Geometry) -> Transitions:
    """Let two equal objects, with their goals, change places in half of the rows."""
    chosen = torch.rand_like(rows.reward) < 0.5

    def swapped(values: Tensor, begin: int) -> Tensor:
        """Exchange the halves of what follows ``begin``."""
        first, second = values[:, begin:].chunk(2, 1)
        other = torch.cat((values[:, :begin], second, first), 1)
        return torch.where(chosen, other, values)

    _, begin, _ = geometry.positions
    return rows._replace(
        observation=swapped(rows.observation, begin),
        goal=swapped(rows.goal, 0),
        next_observation=swapped(rows.next_observation, begin),
    )
