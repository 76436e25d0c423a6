"""Push: push a cube to a point on the table."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from torch import Tensor

from torch_panda.bullet import PhysicsClient, VectorSimulation
from torch_panda.checks import check_above_zero, check_not_negative
from torch_panda.rotations import NO_ROTATION
from torch_panda.tasks.base import (
    OBJECT_LAYOUT,
    Bodies,
    GoalEntries,
    Task,
    object_observation,
)
from torch_panda.tasks.table import (
    CUBE,
    CUBE_SIZE,
    TABLE_FRICTION,
    create_cube,
    create_table,
    sample_on_table,
)


@dataclass(kw_only=True, eq=False, repr=False)
class Push(Task):
    """Push a cube to a point on the table.

    Args:
        reward_type: "sparse" or "dense"; see `Task`.
        distance_threshold: Distance below which a goal is reached [m].
        goal_xy_range: Edge length of the square of goals [m].
        obj_xy_range: Edge length of the square of start positions [m].
        object_mass: Mass of the cube [kg].
        object_friction: Lateral friction of the cube.
        table_friction: Lateral friction of the table.
    """

    goal_dim = 3
    observation_dim = 12
    goal_entries = GoalEntries("task", (0, 1, 2))
    observation_layout = OBJECT_LAYOUT
    changeable: ClassVar[tuple[str, ...]] = ("goal_xy_range", "obj_xy_range")
    # Height at which panda-gym creates the marker, before it draws a goal [m]. It is
    # part of Bullet's tree of AABBs, which decides the order of contacts.
    _marker_height = CUBE_SIZE / 2

    goal_xy_range: float = 0.3
    obj_xy_range: float = 0.3
    object_mass: float = 2.0
    object_friction: float = 0.5
    table_friction: float = TABLE_FRICTION

    def check_arguments(self) -> None:
        """Check the arguments; see `Task`."""
        super().check_arguments()
        check_not_negative(
            goal_xy_range=self.goal_xy_range,
            obj_xy_range=self.obj_xy_range,
            object_friction=self.object_friction,
            table_friction=self.table_friction,
        )
        check_above_zero(object_mass=self.object_mass)

    def build(self, client: PhysicsClient) -> Bodies:
        """Build the table, the cube and the marker."""
        create_table(client, friction=self.table_friction)
        cube = create_cube(client, mass=self.object_mass, friction=self.object_friction)
        return Bodies(
            objects=(cube,),
            markers=(client.create_marker((0.0, 0.0, self._marker_height), CUBE),),
        )

    def sample_goal(self, rng: np.random.Generator) -> Sequence[float]:
        """Draw a position of the cube on the table, (3,)."""
        return sample_on_table(rng, self.goal_xy_range, height=CUBE_SIZE / 2)

    def sample_objects(self, rng: np.random.Generator) -> Sequence[Sequence[float]]:
        """Draw the pose of the cube on the table, (1, 7)."""
        position = sample_on_table(rng, self.obj_xy_range, height=CUBE_SIZE / 2)
        return ((*position, *NO_ROTATION),)

    def observation(self, simulation: VectorSimulation) -> Tensor:
        """Pose and velocities of the cube.

        Returns:
            (num_envs, 12): position of the cube; roll, pitch and yaw of the cube;
            velocity of the cube; angular velocity of the cube.
        """
        return object_observation(simulation, 0)

    def achieved_goal(self, simulation: VectorSimulation) -> Tensor:
        """Position of the cube, (num_envs, 3)."""
        return simulation.object_position.select(1, 0)
