"""PickAndPlace: bring a cube to a point on or above the table."""

from collections.abc import Sequence

import numpy as np

from torch_panda.tasks.base import (
    RewardType,
)
from torch_panda.tasks.push import Push
from torch_panda.tasks.table import (
    CUBE_SIZE,
    TABLE_FRICTION,
    sample_on_table,
)

# Fraction of the goals that lie on the table, in the authors' code.
GOALS_ON_TABLE = 0.3


class PickAndPlace(Push):
    """Bring a cube to a point on or above the table.

    Args:
        reward_type: "sparse" or "dense".
        distance_threshold: success is a distance below it [m].
        goal_xy_range: edge length of the goals' box along x and y [m].
        goal_z_range: height of the goals' box [m].
        obj_xy_range: edge length of the square of start positions [m].
        object_mass: of the cube [kg].
        object_friction: lateral friction of the cube.
        table_friction: lateral friction of the table.
    """

    marker_height = 0.05

    def __init__(
        self,
        *,
        reward_type: RewardType = "sparse",
        distance_threshold: float = 0.05,
        goal_xy_range: float = 0.3,
        goal_z_range: float = 0.2,
        obj_xy_range: float = 0.3,
        object_mass: float = 2.0,
        object_friction: float = 5.0,
        table_friction: float = TABLE_FRICTION,
    ) -> None:
        super().__init__(
            reward_type=reward_type,
            distance_threshold=distance_threshold,
            goal_xy_range=goal_xy_range,
            obj_xy_range=obj_xy_range,
            object_mass=object_mass,
            object_friction=object_friction,
            table_friction=table_friction,
        )
        self.goal_z_range = goal_z_range

    def sample_goal(self, rng: np.random.Generator) -> Sequence[float]:
        """Draw a position of the cube, three in ten on the table: (3,)."""
        height = rng.uniform(0.0, self.goal_z_range)
        if rng.random() < GOALS_ON_TABLE:
            height = 0.0
        return sample_on_table(rng, self.goal_xy_range, height=CUBE_SIZE / 2 + height)
