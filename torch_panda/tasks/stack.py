"""Stack: stack two cubes at a point on the table."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from torch_panda.bullet import PhysicsClient, VectorSimulation, Visual
from torch_panda.bullet.shapes import GREEN, RED, Color
from torch_panda.checks import check_above_zero, check_not_negative
from torch_panda.rotations import NO_ROTATION
from torch_panda.tasks.base import OBJECT_LAYOUT, Bodies, GoalEntries, Task
from torch_panda.tasks.table import (
    CUBE,
    CUBE_SIZE,
    TABLE_FRICTION,
    create_cube,
    create_table,
    sample_on_table,
)

# Heights of the centres [m].
LOWER_HEIGHT = CUBE_SIZE / 2
UPPER_HEIGHT = 3 * CUBE_SIZE / 2


@dataclass(kw_only=True, eq=False, repr=False)
class Stack(Task):
    """Stack two cubes at a point on the table.

    A goal holds the position of the lower cube, and then the position of the upper
    cube. The upper cube starts one cube's height above the table, so it may start on
    the lower cube.

    Args:
        reward_type: "sparse" or "dense"; see `Task`.
        distance_threshold: Distance below which a goal is reached [m].
        per_object: Whether each cube must be within the threshold, as in the paper.
            Otherwise the distance between the whole goals (6 numbers) must be within
            it, as in panda-gym 3.
        goal_xy_range: Edge length of the square of goals [m].
        obj_xy_range: Edge length of the square of start positions [m].
        lower_color: Colour of the lower cube and its marker.
        upper_color: Colour of the upper cube and its marker.
        object_mass: Masses of the lower and the upper cube [kg].
        object_friction: Lateral friction of both cubes.
        table_friction: Lateral friction of the table.
    """

    goal_dim = 6
    observation_dim = 24
    goal_entries = GoalEntries("task", (0, 1, 2, 12, 13, 14))
    observation_layout = OBJECT_LAYOUT * 2
    max_episode_steps = 100
    changeable: ClassVar[tuple[str, ...]] = ("goal_xy_range", "obj_xy_range")

    per_object: bool = True
    goal_xy_range: float = 0.3
    obj_xy_range: float = 0.3
    lower_color: Color = RED
    upper_color: Color = GREEN
    object_mass: tuple[float, float] = (2.0, 2.0)
    object_friction: float = 5.0
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
        if np.shape(self.object_mass) != (2,):
            raise ValueError(
                f"object_mass must be the masses of the lower and the upper cube, got "
                f"{self.object_mass!r}"
            )
        for mass in self.object_mass:
            check_above_zero(object_mass=mass)

    def build(self, client: PhysicsClient) -> Bodies:
        """Build the table, both cubes and their markers."""
        create_table(client, friction=self.table_friction)
        lower_mass, upper_mass = self.object_mass
        friction = self.object_friction
        lower_visual, upper_visual = Visual(self.lower_color), Visual(self.upper_color)
        lower = create_cube(
            client, mass=lower_mass, friction=friction, visual=lower_visual
        )
        lower_marker = client.create_marker((0.0, 0.0, 0.05), CUBE, visual=lower_visual)
        upper = create_cube(
            client, mass=upper_mass, friction=friction, x=0.5, visual=upper_visual
        )
        upper_marker = client.create_marker((0.5, 0.0, 0.05), CUBE, visual=upper_visual)
        return Bodies(objects=(lower, upper), markers=(lower_marker, upper_marker))

    def sample_goal(self, rng: np.random.Generator) -> Sequence[float]:
        """Draw a position of the stack, (6,)."""
        x, y, _ = sample_on_table(rng, self.goal_xy_range, height=0.0)
        return (x, y, LOWER_HEIGHT, x, y, UPPER_HEIGHT)

    def sample_objects(self, rng: np.random.Generator) -> Sequence[Sequence[float]]:
        """Draw the poses of both cubes, (2, 7)."""
        return tuple(
            (*sample_on_table(rng, self.obj_xy_range, height=height), *NO_ROTATION)
            for height in (LOWER_HEIGHT, UPPER_HEIGHT)
        )

    def observation(self, simulation: VectorSimulation) -> Tensor:
        """Poses and velocities of both cubes.

        Returns:
            (num_envs, 24): position of the lower cube; roll, pitch and yaw of the lower
            cube; velocity of the lower cube; angular velocity of the lower cube;
            position of the upper cube; roll, pitch and yaw of the upper cube; velocity
            of the upper cube; angular velocity of the upper cube.
        """
        return simulation.object_state.flatten(1)

    def achieved_goal(self, simulation: VectorSimulation) -> Tensor:
        """Positions of both cubes, (num_envs, 6)."""
        return simulation.object_pose[:, :, :3].flatten(1)

    def success_distance(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """The larger of both cubes' distances, or the whole distance, (..., 1).

        ``per_object`` chooses between them.
        """
        if not self.per_object:
            return self.distance(achieved_goal, desired_goal)
        offset = (achieved_goal - desired_goal).unflatten(-1, (2, 3))
        return torch.linalg.vector_norm(offset, dim=-1).amax(-1, keepdim=True)
