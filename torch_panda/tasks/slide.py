"""Slide: strike a puck so that it stops at a point out of reach."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from torch import Tensor

from torch_panda.bullet import Cylinder, PhysicsClient, VectorSimulation
from torch_panda.checks import check_above_zero, check_finite, check_not_negative
from torch_panda.rotations import NO_ROTATION
from torch_panda.tasks.base import (
    OBJECT_LAYOUT,
    Bodies,
    GoalEntries,
    Task,
    object_observation,
)
from torch_panda.tasks.table import TABLE_FRICTION, create_table, sample_on_table

PUCK_RADIUS = 0.03  # [m]
PUCK_HEIGHT = 0.03  # [m]
# Height of the centre at the start and of the goals, as in panda-gym. The puck drops
# 1.5 cm from there.
PUCK_START_HEIGHT = 0.03  # [m]


@dataclass(kw_only=True, eq=False, repr=False)
class Slide(Task):
    """Strike a puck so that it slides to a point and stops there.

    By default the square of goals has the paper's size, and the arm cannot reach it:
    the hand comes at most 0.855 m away from the arm's base, which is at x = -0.6 m.

    Args:
        reward_type: "sparse" or "dense"; see `Task`.
        distance_threshold: Distance below which a goal is reached [m].
        goal_xy_range: Edge length of the square of goals [m].
        goal_x_offset: x coordinate of the centre of this square [m].
        obj_xy_range: Edge length of the square of start positions [m].
        table_length: Length of the table along x [m].
        table_x_offset: x coordinate of the centre of the table [m].
        object_mass: Mass of the puck [kg].
        object_friction: Lateral friction of the puck.
        table_friction: Lateral friction of the table.
    """

    goal_dim = 3
    observation_dim = 12
    goal_entries = GoalEntries("task", (0, 1, 2))
    observation_layout = OBJECT_LAYOUT
    sampled_goal_height = PUCK_START_HEIGHT
    changeable: ClassVar[tuple[str, ...]] = (
        "goal_xy_range",
        "goal_x_offset",
        "obj_xy_range",
    )

    goal_xy_range: float = 0.5
    goal_x_offset: float = 0.51
    obj_xy_range: float = 0.3
    table_length: float = 1.9
    table_x_offset: float = 0.15
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
        check_finite(
            goal_x_offset=self.goal_x_offset, table_x_offset=self.table_x_offset
        )
        check_above_zero(table_length=self.table_length, object_mass=self.object_mass)

    def build(self, client: PhysicsClient) -> Bodies:
        """Build the table, the puck and the marker."""
        create_table(
            client,
            length=self.table_length,
            x_offset=self.table_x_offset,
            friction=self.table_friction,
        )
        puck = client.create_cylinder(
            PUCK_RADIUS,
            PUCK_HEIGHT,
            mass=self.object_mass,
            position=(0.0, 0.0, PUCK_START_HEIGHT),
        )
        client.set_friction(puck, lateral=self.object_friction)
        marker = client.create_marker(
            (0.0, 0.0, PUCK_START_HEIGHT), Cylinder(PUCK_RADIUS, PUCK_HEIGHT)
        )
        return Bodies(objects=(puck,), markers=(marker,))

    def sample_goal(self, rng: np.random.Generator) -> Sequence[float]:
        """Draw a position of the puck in the square of goals, (3,)."""
        return sample_on_table(
            rng,
            self.goal_xy_range,
            height=PUCK_START_HEIGHT,
            x_offset=self.goal_x_offset,
        )

    def sample_objects(self, rng: np.random.Generator) -> Sequence[Sequence[float]]:
        """Draw the pose of the puck within reach, (1, 7)."""
        position = sample_on_table(rng, self.obj_xy_range, height=PUCK_START_HEIGHT)
        return ((*position, *NO_ROTATION),)

    def observation(self, simulation: VectorSimulation) -> Tensor:
        """Pose and velocities of the puck.

        Returns:
            (num_envs, 12): position of the puck; roll, pitch and yaw of the puck;
            velocity of the puck; angular velocity of the puck.
        """
        return object_observation(simulation, 0)

    def achieved_goal(self, simulation: VectorSimulation) -> Tensor:
        """Position of the puck, (num_envs, 3)."""
        return simulation.object_position.select(1, 0)
