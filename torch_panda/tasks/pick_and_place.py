"""PickAndPlace: move a cube to a point on or above the table."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from torch_panda.checks import check_not_negative
from torch_panda.tasks.push import Push
from torch_panda.tasks.table import CUBE_SIZE, sample_on_table

# Share of the goals that lie on the table, as in the code of the paper's authors.
GOALS_ON_TABLE = 0.3


@dataclass(kw_only=True, eq=False, repr=False)
class PickAndPlace(Push):
    """Move a cube to a point on or above the table.

    Args:
        reward_type: "sparse" or "dense"; see `Task`.
        distance_threshold: Distance below which a goal is reached [m].
        goal_xy_range: Edge length of the box of goals along x and y [m].
        goal_z_range: Height of the box of goals [m].
        obj_xy_range: Edge length of the square of start positions [m].
        object_mass: Mass of the cube [kg].
        object_friction: Lateral friction of the cube.
        table_friction: Lateral friction of the table.
    """

    changeable: ClassVar[tuple[str, ...]] = ("goal_z_range",)
    _marker_height = 0.05

    goal_z_range: float = 0.2
    object_friction: float = 5.0

    def check_arguments(self) -> None:
        """Check the arguments; see `Task`."""
        super().check_arguments()
        check_not_negative(goal_z_range=self.goal_z_range)

    def sample_goal(self, rng: np.random.Generator) -> Sequence[float]:
        """Draw a position of the cube, (3,); 30 % of the positions are on the table."""
        height = rng.uniform(0.0, self.goal_z_range)
        if rng.random() < GOALS_ON_TABLE:
            height = 0.0
        return sample_on_table(rng, self.goal_xy_range, height=CUBE_SIZE / 2 + height)
