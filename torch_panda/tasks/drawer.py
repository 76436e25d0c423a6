"""Drawer: open or close a drawer until its handle is at a point."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from torch_panda.bullet import PhysicsClient, VectorSimulation
from torch_panda.bullet.shapes import Box
from torch_panda.checks import check_above_zero, check_not_negative
from torch_panda.rotations import NO_ROTATION, rotate
from torch_panda.tasks.base import Bodies, GoalEntries, ObjectState, Start, Task
from torch_panda.tasks.table import TABLE_FRICTION, create_table

URDF = Path(__file__).with_name("drawer.urdf")
SLIDE = 0  # index of the drawer's joint
TRAVEL = 0.25  # distance from closed to open [m]
HANDLE = (-0.06, 0.0, 0.06)  # position when closed, cabinet frame [m]
# The marker is thicker than the handle, so it stays visible when the handle is inside.
MARKER = Box((0.009, 0.074, 0.014))

# The table is longer than panda-gym's, because the cabinet stands at its far end.
TABLE_LENGTH = 1.4  # [m]
TABLE_X_OFFSET = -0.15  # [m]
CABINET_X = 0.15  # x coordinate of the cabinet's front, mean of all episodes [m]


@dataclass(kw_only=True, eq=False, repr=False)
class Drawer(Task):
    """Open or close a drawer until its handle is at a point.

    The goal is a position of the handle, at least ``min_change`` from its start.

    Args:
        reward_type: "sparse" or "dense"; see `Task`.
        distance_threshold: Distance below which a goal is reached [m].
        cabinet_x_range: Width of the range of the cabinet's x coordinate [m].
        cabinet_y_range: Width of the range of the cabinet's y coordinate [m].
        min_change: Smallest distance between start and goal, at most 0.125 [m].
        drawer_mass: Mass of the drawer [kg].
        drawer_friction: Friction force of the slide [N].
        table_friction: Lateral friction of the table.
    """

    goal_dim = 3
    observation_dim = 5
    goal_entries = GoalEntries("task", (0, 1, 2))
    observation_layout = ("position", "number", "number")
    changeable: ClassVar[tuple[str, ...]] = (
        "cabinet_x_range",
        "cabinet_y_range",
        "min_change",
    )

    cabinet_x_range: float = 0.06
    cabinet_y_range: float = 0.2
    min_change: float = 0.1
    drawer_mass: float = 1.0
    drawer_friction: float = 5.0
    table_friction: float = TABLE_FRICTION

    def check_arguments(self) -> None:
        """Check the arguments; see `Task`."""
        super().check_arguments()
        check_not_negative(
            cabinet_x_range=self.cabinet_x_range,
            cabinet_y_range=self.cabinet_y_range,
            min_change=self.min_change,
            drawer_friction=self.drawer_friction,
            table_friction=self.table_friction,
        )
        check_above_zero(drawer_mass=self.drawer_mass)
        # From the middle of the slide, no goal is farther than half of its length.
        if self.min_change > TRAVEL / 2:
            raise ValueError(
                f"min_change must be from 0 to {TRAVEL / 2} [m], got {self.min_change}"
            )

    def build(self, client: PhysicsClient) -> Bodies:
        """Build the table, the drawer and the marker, which looks like a handle."""
        create_table(
            client,
            length=TABLE_LENGTH,
            x_offset=TABLE_X_OFFSET,
            friction=self.table_friction,
        )
        drawer = client.load_urdf(URDF, position=(CABINET_X, 0.0, 0.0), fixed_base=True)
        client.set_dynamics(drawer, SLIDE, mass=self.drawer_mass)
        client.set_joint_friction(drawer, SLIDE, self.drawer_friction)
        return Bodies(
            objects=(drawer,), markers=(client.create_marker(HANDLE, MARKER),)
        )

    def sample_start(self, rng: np.random.Generator) -> Start:
        """Draw the cabinet's position, and the drawer's openings at start and goal."""
        x = CABINET_X + self.cabinet_x_range * rng.uniform(-0.5, 0.5)
        y = self.cabinet_y_range * rng.uniform(-0.5, 0.5)
        # Rejection sampling: uniform among the pairs that are far enough apart.
        start, goal = rng.uniform(0.0, TRAVEL, size=2)
        while abs(goal - start) < self.min_change:
            start, goal = rng.uniform(0.0, TRAVEL, size=2)
        handle = np.add((x - goal, y, 0.0), HANDLE)
        return Start(handle.tolist(), ((x, y, 0.0, *NO_ROTATION),), (start,))

    def observation(self, simulation: VectorSimulation) -> Tensor:
        """Position of the handle, and position and velocity of the slide.

        Returns:
            (num_envs, 5): position of the handle; distance by which the drawer is open;
            speed at which the drawer opens.
        """
        slide = simulation.object_joint_position, simulation.object_joint_velocity
        return torch.cat((self.achieved_goal(simulation), *slide), dim=1)

    def achieved_goal(self, simulation: VectorSimulation) -> Tensor:
        """Position of the handle, (num_envs, 3)."""
        pose, opening = simulation.object_pose[:, 0], simulation.object_joint_position
        handle = pose.new_tensor(HANDLE) - opening * pose.new_tensor((1.0, 0.0, 0.0))
        return pose[:, :3] + rotate(pose[:, 3:], handle)

    def objects_at_goal(self, goal: Tensor, objects: ObjectState) -> ObjectState:
        """The unmoved cabinet, with the drawer's handle at the goal."""
        pose = objects.pose[:, 0]
        closed = pose[:, :3] + rotate(pose[:, 3:], pose.new_tensor(HANDLE))
        outwards = rotate(pose[:, 3:], pose.new_tensor((-1.0, 0.0, 0.0)))
        opening = ((goal - closed) * outwards).sum(dim=1, keepdim=True)
        return objects._replace(joint_position=opening)
