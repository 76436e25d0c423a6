"""PegInsertion: insert a peg into a hole."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from torch_panda.bullet import PhysicsClient, VectorSimulation, Visual
from torch_panda.bullet.shapes import RED, Box
from torch_panda.checks import check_above_zero, check_not_negative
from torch_panda.rotations import NO_ROTATION, rotate
from torch_panda.tasks.base import (
    OBJECT_LAYOUT,
    Bodies,
    GoalEntries,
    ObjectState,
    Start,
    Task,
    object_observation,
)
from torch_panda.tasks.table import TABLE_FRICTION, create_table, sample_on_table

URDF = Path(__file__).with_name("hole.urdf")
HOLE_WIDTH = 0.021  # edge length of the square hole [m]
HOLE_DEPTH = 0.05  # height of the block that the hole goes through [m]
PEG_LENGTH = 0.08  # [m]
# Distance between the fingers throughout an episode [m]. It is a little less than the
# width of the peg (with the default clearance), so the fingers press on the peg. If it
# were much less, the peg could slip from one finger towards the other.
GRASP_WIDTH = 0.0198
# Centre of the peg at the start, world frame [m]. The end-effector of a neutral Panda
# is at (0.0384, 0, 0.1974), so the fingers hold the upper part of the peg.
PEG_POSITION = (0.0384, 0.0, 0.1774)


@dataclass(kw_only=True, eq=False, repr=False)
class PegInsertion(Task):
    """Insert a square peg, which the hand holds from the start, into a square hole.

    Goals are positions of the peg's lower end. The threshold is so small that the end
    can be near a goal only if it is in the hole.

    Args:
        reward_type: "sparse" or "dense"; see `Task`.
        distance_threshold: Distance below which a goal is reached [m].
        depth: Depth of the goal in the hole [m].
        clearance: Difference between the widths of hole and peg [m].
        hole_xy_range: Edge length of the square of positions of the hole [m].
        peg_mass: Mass of the peg [kg].
        peg_friction: Lateral friction of the peg.
        table_friction: Lateral friction of the table.
    """

    goal_dim = 3
    observation_dim = 15
    goal_entries = GoalEntries("task", (0, 1, 2))
    observation_layout = (*OBJECT_LAYOUT, "position")
    changeable: ClassVar[tuple[str, ...]] = ("hole_xy_range",)

    distance_threshold: float = 0.01
    depth: float = 0.03
    clearance: float = 0.001
    hole_xy_range: float = 0.2
    peg_mass: float = 0.1
    peg_friction: float = 0.5
    table_friction: float = TABLE_FRICTION

    def check_arguments(self) -> None:
        """Check the arguments; see `Task`."""
        super().check_arguments()
        check_not_negative(
            hole_xy_range=self.hole_xy_range,
            peg_friction=self.peg_friction,
            table_friction=self.table_friction,
        )
        check_above_zero(
            depth=self.depth, clearance=self.clearance, peg_mass=self.peg_mass
        )
        if not self.clearance < HOLE_WIDTH:
            raise ValueError(
                f"clearance must be between 0 and {HOLE_WIDTH} [m], got "
                f"{self.clearance}"
            )
        if not self.distance_threshold <= self.depth <= HOLE_DEPTH:
            raise ValueError(
                f"depth must be from distance_threshold, {self.distance_threshold}, to "
                f"{HOLE_DEPTH} [m], got {self.depth}"
            )

    def build(self, client: PhysicsClient) -> Bodies:
        """Build the table, the peg, the block with the hole, and the marker (a peg)."""
        create_table(client, friction=self.table_friction)
        side = (HOLE_WIDTH - self.clearance) / 2
        shape = Box((side, side, PEG_LENGTH / 2))
        peg = client.create_box(
            shape.half_extents,
            mass=self.peg_mass,
            position=PEG_POSITION,
            visual=Visual(RED, name="peg"),
        )
        client.set_friction(peg, lateral=self.peg_friction)
        hole = client.load_urdf(URDF, fixed_base=True)
        return Bodies(
            objects=(peg, hole), markers=(client.create_marker(PEG_POSITION, shape),)
        )

    def marker_pose(self, goal: Tensor) -> Tensor:
        """Pose of a peg whose lower end is at the goal, (..., 1, 7)."""
        return super().marker_pose(goal + goal.new_tensor((0.0, 0.0, PEG_LENGTH / 2)))

    def sample_start(self, rng: np.random.Generator) -> Start:
        """Draw the position of the hole. The peg starts in the hand."""
        x, y, _ = hole = sample_on_table(rng, self.hole_xy_range, height=0.0)
        return Start(
            (x, y, HOLE_DEPTH - self.depth),
            ((*PEG_POSITION, *NO_ROTATION), (*hole, *NO_ROTATION)),
        )

    def observation(self, simulation: VectorSimulation) -> Tensor:
        """State of the peg and position of the hole.

        Returns:
            (num_envs, 15): position of the peg's lower end; roll, pitch and yaw of the
            peg; velocity of the peg's middle; angular velocity of the peg; position of
            the hole's middle, on the table.
        """
        peg = object_observation(simulation, 0)[:, 3:]
        hole = simulation.object_pose[:, 1, :3]
        return torch.cat((self.achieved_goal(simulation), peg, hole), dim=1)

    def achieved_goal(self, simulation: VectorSimulation) -> Tensor:
        """Position of the peg's lower end, (num_envs, 3)."""
        pose = simulation.object_pose[:, 0]
        end = pose.new_tensor((0.0, 0.0, -PEG_LENGTH / 2))
        return pose[:, :3] + rotate(pose[:, 3:], end)

    def objects_at_goal(self, goal: Tensor, objects: ObjectState) -> ObjectState:
        """The peg upright with its lower end at the goal, and the hole unchanged."""
        pose = objects.pose.clone()
        pose[:, 0, :3] = goal + goal.new_tensor((0.0, 0.0, PEG_LENGTH / 2))
        pose[:, 0, 3:] = goal.new_tensor(NO_ROTATION)
        return objects._replace(pose=pose)
