"""Slide: send a puck to a point out of reach."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from torch_panda.bullet import Cylinder, PhysicsClient, VectorSimulation
from torch_panda.rotations import NO_ROTATION
from torch_panda.tasks.base import Bodies, GoalEntries, Task, object_observation
from torch_panda.tasks.table import TABLE_FRICTION, create_table, sample_on_table

PUCK_RADIUS = 0.03  # [m]
PUCK_HEIGHT = 0.03  # [m]
# Poses are given at this height, as in panda-gym; the puck drops 1.5 cm from there.
PUCK_START_HEIGHT = 0.03  # [m]


@dataclass(kw_only=True, eq=False, repr=False)
class Slide(Task):
    """Hit a puck so that it slides to a point and stops there.

    The defaults are the paper's: a square that the arm, whose reach is 0.855 m from its
    base at x = -0.6, cannot get to.

    Args:
        reward_type: "sparse" or "dense".
        distance_threshold: success is a distance below it [m].
        goal_xy_range: edge length of the square of goals [m].
        goal_x_offset: x of the centre of that square [m].
        obj_xy_range: edge length of the square of start positions [m].
        table_length: length of the table along x [m].
        table_x_offset: x of its centre [m].
        object_mass: of the puck [kg].
        object_friction: lateral friction of the puck.
        table_friction: lateral friction of the table.
    """

    goal_dim = 3
    observation_dim = 12
    goal_entries = GoalEntries("task", (0, 1, 2))

    goal_xy_range: float = 0.5
    goal_x_offset: float = 0.51
    obj_xy_range: float = 0.3
    table_length: float = 1.9
    table_x_offset: float = 0.15
    object_mass: float = 2.0
    object_friction: float = 0.5
    table_friction: float = TABLE_FRICTION

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
        """Draw a position of the puck out of reach: (3,)."""
        return sample_on_table(
            rng,
            self.goal_xy_range,
            height=PUCK_START_HEIGHT,
            x_offset=self.goal_x_offset,
        )

    def sample_objects(self, rng: np.random.Generator) -> Sequence[Sequence[float]]:
        """Draw the puck's pose within reach: (1, 7)."""
        position = sample_on_table(rng, self.obj_xy_range, height=PUCK_START_HEIGHT)
        return ((*position, *NO_ROTATION),)

    def observation(self, simulation: VectorSimulation) -> Tensor:
        """The puck's position, Euler angles and velocity: (num_envs, 12)."""
        return object_observation(simulation, 0)

    def achieved_goal(self, simulation: VectorSimulation) -> Tensor:
        """The puck's position: (num_envs, 3)."""
        return simulation.object_pose[:, 0, :3]
