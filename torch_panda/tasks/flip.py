"""Flip: rotate a cube to an orientation."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from torch_panda.bullet import PhysicsClient, VectorSimulation, Visual
from torch_panda.checks import check_above_zero, check_not_negative
from torch_panda.rotations import NO_ROTATION, inverse, rotate, rotation_distance
from torch_panda.tasks.base import Bodies, GoalEntries, ObjectState, Task
from torch_panda.tasks.table import (
    CUBE,
    CUBE_SIZE,
    TABLE_FRICTION,
    create_cube,
    create_table,
    sample_on_table,
)

# The marker floats above the table, where the cube does not hide it.
MARKER_POSITION = (0.0, 0.0, 3 * CUBE_SIZE / 2)  # [m]
# The six faces differ in colour and, like those of a die, in their number of pips.
VISUAL = Visual(texture=Path(__file__).with_name("flip_cube.png"), opacity=0.5)


@dataclass(kw_only=True, eq=False, repr=False)
class Flip(Task):
    """Rotate a cube to an orientation. Its position does not matter.

    Goals are unit quaternions xyzw. The distance between two goals is 1 - <q, q'>^2,
    the squared sine of half the angle between them. It is the same for q and -q, which
    are one orientation.

    Args:
        reward_type: "sparse" or "dense"; see `Task`.
        distance_threshold: Distance below which a goal is reached.
        obj_xy_range: Edge length of the square of start positions [m].
        object_mass: Mass of the cube [kg].
        object_friction: Lateral friction of the cube.
        table_friction: Lateral friction of the table.
    """

    goal_dim = 4
    observation_dim = 13
    goal_entries = GoalEntries("task", (3, 4, 5, 6))
    observation_layout = ("position", "cube_quaternion", "velocity", "angular_velocity")
    changeable: ClassVar[tuple[str, ...]] = ("obj_xy_range",)

    distance_threshold: float = 0.2
    obj_xy_range: float = 0.3
    object_mass: float = 1.0
    object_friction: float = 0.5
    table_friction: float = TABLE_FRICTION

    def check_arguments(self) -> None:
        """Check the arguments; see `Task`."""
        super().check_arguments()
        check_not_negative(
            obj_xy_range=self.obj_xy_range,
            object_friction=self.object_friction,
            table_friction=self.table_friction,
        )
        check_above_zero(object_mass=self.object_mass)

    def build(self, client: PhysicsClient) -> Bodies:
        """Build the table, the cube and the marker."""
        create_table(client, friction=self.table_friction)
        cube = create_cube(
            client, mass=self.object_mass, friction=self.object_friction, visual=VISUAL
        )
        return Bodies(
            objects=(cube,),
            markers=(client.create_marker(MARKER_POSITION, CUBE, visual=VISUAL),),
        )

    def marker_pose(self, goal: Tensor) -> Tensor:
        """Pose of the marker, which shows the orientation, (..., 1, 7)."""
        position = goal.new_tensor(MARKER_POSITION).expand(*goal.shape[:-1], 3)
        return torch.cat((position, goal), dim=-1).unsqueeze(-2)

    def sample_goal(self, rng: np.random.Generator) -> Sequence[float]:
        """Draw an orientation uniformly among all, (4,)."""
        quaternion = rng.standard_normal(4)
        return (quaternion / np.linalg.norm(quaternion)).tolist()

    def sample_objects(self, rng: np.random.Generator) -> Sequence[Sequence[float]]:
        """Draw the pose of the cube on the table, (1, 7)."""
        position = sample_on_table(rng, self.obj_xy_range, height=CUBE_SIZE / 2)
        return ((*position, *NO_ROTATION),)

    def observation(self, simulation: VectorSimulation) -> Tensor:
        """Pose and velocities of the cube.

        Returns:
            (num_envs, 13): position of the cube; quaternion xyzw of the cube; velocity
            of the cube; angular velocity of the cube.
        """
        pose, velocity = simulation.object_pose[:, 0], simulation.object_velocity[:, 0]
        return torch.cat((pose, velocity), dim=1)

    def achieved_goal(self, simulation: VectorSimulation) -> Tensor:
        """Orientation of the cube, quaternion xyzw, (num_envs, 4)."""
        return simulation.object_pose[:, 0, 3:]

    def objects_at_goal(self, goal: Tensor, objects: ObjectState) -> ObjectState:
        """The cube in the goal's orientation, with its lowest corner on the table."""
        position = torch.zeros_like(goal[:, :3])
        upwards = goal.new_tensor((0.0, 0.0, 1.0))
        # In the cube's frame, the 1-norm of the table's normal is the height of the
        # centre above the lowest corner, in half edge lengths.
        normal = rotate(inverse(goal), upwards)
        position[:, 2] = CUBE_SIZE / 2 * normal.abs().sum(dim=1)
        return objects._replace(pose=torch.cat((position, goal), dim=1).unsqueeze(1))

    def distance(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """1 - <q, q'>^2, from 0 to 1, (..., 1)."""
        return rotation_distance(achieved_goal, desired_goal)
