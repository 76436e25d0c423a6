"""Drawer: open or close a drawer to a position."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torch_panda.bullet import PhysicsClient, VectorSimulation
from torch_panda.bullet.shapes import Box
from torch_panda.rotations import NO_ROTATION, rotate
from torch_panda.tasks.base import Bodies, GoalEntries, ObjectState, Start, Task
from torch_panda.tasks.table import TABLE_FRICTION, create_table

URDF = Path(__file__).with_name("drawer.urdf")
SLIDE = 0  # index of its joint
TRAVEL = 0.25  # [m], from closed to open
HANDLE = (-0.06, 0.0, 0.06)  # of the closed drawer, cabinet frame [m]
HANDLE_BAR = Box((0.005, 0.07, 0.01))

# A table on which the cabinet stands behind what the arm reaches [m].
TABLE_LENGTH = 1.4
TABLE_X_OFFSET = -0.15
CABINET_X = 0.15  # of its front, in the middle of its range [m]


@dataclass(kw_only=True, eq=False, repr=False)
class Drawer(Task):
    """Open or close a drawer, by its handle, until that is at a point.

    The goal is where the handle is when the drawer is as far open as it should be. It
    is ``min_change`` or more from where the handle starts.

    Args:
        reward_type: "sparse" or "dense".
        distance_threshold: success is a distance below it [m].
        cabinet_x_range: edge length along x of the rectangle of its places [m].
        cabinet_y_range: edge length along y [m].
        min_change: the least by which the drawer is to be moved, at most 0.125 [m].
        drawer_mass: [kg].
        drawer_friction: force with which the slide resists motion [N].
        table_friction: lateral friction of the table.
    """

    goal_dim = 3
    observation_dim = 5
    goal_entries = GoalEntries("task", (0, 1, 2))

    cabinet_x_range: float = 0.06
    cabinet_y_range: float = 0.2
    min_change: float = 0.1
    drawer_mass: float = 1.0
    drawer_friction: float = 5.0
    table_friction: float = TABLE_FRICTION

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.min_change <= TRAVEL / 2:  # else none may be left to draw
            raise ValueError(
                f"min_change must be from 0 to {TRAVEL / 2} [m], got {self.min_change}"
            )

    def build(self, client: PhysicsClient) -> Bodies:
        """Build the table, the drawer and the marker, a handle."""
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
            objects=(drawer,), markers=(client.create_marker(HANDLE, HANDLE_BAR),)
        )

    def sample_start(self, rng: np.random.Generator) -> Start:
        """Draw where the cabinet stands, how far it is open, and should be."""
        x = CABINET_X + self.cabinet_x_range * rng.uniform(-0.5, 0.5)
        y = self.cabinet_y_range * rng.uniform(-0.5, 0.5)
        # Uniform among the pairs that are far enough from each other.
        start, goal = rng.uniform(0.0, TRAVEL, size=2)
        while abs(goal - start) < self.min_change:
            start, goal = rng.uniform(0.0, TRAVEL, size=2)
        handle = np.add((x - goal, y, 0.0), HANDLE)
        return Start(handle.tolist(), ((x, y, 0.0, *NO_ROTATION),), (start,))

    def observation(self, simulation: VectorSimulation) -> Tensor:
        """Position of the handle, how far it is open, and its speed: (num_envs, 5)."""
        slide = simulation.object_joint_position, simulation.object_joint_velocity
        return torch.cat((self.achieved_goal(simulation), *slide), dim=1)

    def achieved_goal(self, simulation: VectorSimulation) -> Tensor:
        """Position of the handle: (num_envs, 3)."""
        pose, opening = simulation.object_pose[:, 0], simulation.object_joint_position
        handle = pose.new_tensor(HANDLE) - opening * pose.new_tensor((1.0, 0.0, 0.0))
        return pose[:, :3] + rotate(pose[:, 3:], handle)

    def objects_at_goal(self, goal: Tensor, objects: ObjectState) -> ObjectState:
        """The cabinet where it stands, open until its handle is at the goal."""
        pose = objects.pose[:, 0]
        closed = pose[:, :3] + rotate(pose[:, 3:], pose.new_tensor(HANDLE))
        outwards = rotate(pose[:, 3:], pose.new_tensor((-1.0, 0.0, 0.0)))
        opening = ((goal - closed) * outwards).sum(dim=1, keepdim=True)
        return objects._replace(joint_position=opening)
