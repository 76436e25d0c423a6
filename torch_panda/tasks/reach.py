"""Reach: move the end-effector to a point."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from torch import Tensor

from torch_panda.bullet import PhysicsClient, Sphere, VectorSimulation
from torch_panda.checks import check_not_negative
from torch_panda.tasks.base import Bodies, GoalEntries, Task
from torch_panda.tasks.table import TABLE_FRICTION, create_table

MARKER = Sphere(0.02)


@dataclass(kw_only=True, eq=False, repr=False)
class Reach(Task):
    """Move the end-effector to a point in a cube above the table.

    Args:
        reward_type: "sparse" or "dense"; see `Task`.
        distance_threshold: Distance below which a goal is reached [m].
        goal_range: Edge length of the cube of goals [m].
        table_friction: Lateral friction of the table.
    """

    goal_dim = 3
    observation_dim = 0
    goal_entries = GoalEntries("robot", (0, 1, 2))
    observation_layout = ()

    changeable: ClassVar[tuple[str, ...]] = ("goal_range",)

    goal_range: float = 0.3
    table_friction: float = TABLE_FRICTION

    def check_arguments(self) -> None:
        """Check the arguments; see `Task`."""
        super().check_arguments()
        check_not_negative(
            goal_range=self.goal_range, table_friction=self.table_friction
        )

    def build(self, client: PhysicsClient) -> Bodies:
        """Build the table and the marker."""
        create_table(client, friction=self.table_friction)
        return Bodies(markers=(client.create_marker((0.0, 0.0, 0.0), MARKER),))

    def sample_goal(self, rng: np.random.Generator) -> Sequence[float]:
        """Draw a point in the cube of goals, (3,)."""
        half = self.goal_range / 2
        x, y = rng.uniform(-half, half, size=2)
        return float(x), float(y), rng.uniform(0.0, self.goal_range)

    def achieved_goal(self, simulation: VectorSimulation) -> Tensor:
        """Position of the end-effector, (num_envs, 3)."""
        return simulation.ee_position
