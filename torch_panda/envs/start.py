"""The starts of episodes, and the tensors of the state that they are put into."""

import math

import numpy as np
import torch
from torch import Tensor

from torch_panda.bullet import VectorSimulation
from torch_panda.bullet.body_state import Doubles
from torch_panda.envs.seeds import EpisodeSeeds
from torch_panda.envs.state import QUATERNION_TOLERANCE, check_rotations, check_rows
from torch_panda.envs.variation import PHYSICS_PARAMETERS, Variation
from torch_panda.robots import Robot
from torch_panda.tasks import Task


class EpisodeStarts:
    """Draws the starts of n environments' episodes, and puts these there.

    Args:
        robot: starts neutral.
        task: draws goal, objects and their joints.
        simulation: the environments.
        variation: draws their physics.
        seeds: of the episodes.
        goal: (n, goal_dim) float64, the desired goals of the present episodes.

    Attributes:
        goal: the same.
        step_count: (n, 1) int64, steps of the present episodes.
    """

    def __init__(
        self,
        robot: Robot,
        task: Task,
        simulation: VectorSimulation,
        variation: Variation,
        seeds: EpisodeSeeds,
        goal: Tensor,
    ) -> None:
        self._robot, self._task, self._simulation = robot, task, simulation
        self._variation = variation
        self._seeds = seeds
        self._own = type(task).sample_start is not Task.sample_start
        self.goal = goal
        self.step_count = torch.zeros(len(goal), 1, dtype=torch.int64, device="cpu")

    def state(self) -> dict[str, Tensor]:
        """The tensors that hold the physical state, (n, ...); not copies."""
        simulation = self._simulation
        state = {
            "joint_position": simulation.joint_position,
            "joint_velocity": simulation.joint_velocity,
            "object_pose": simulation.object_pose,
            "object_velocity": simulation.object_velocity,
            "desired_goal": self.goal,
            "step_count": self.step_count,
            **self._variation.state,
        }
        if any(simulation.scene.object_joints):
            state["object_joint_position"] = simulation.object_joint_position
            state["object_joint_velocity"] = simulation.object_joint_velocity
        return state

    def draw(self, env: int) -> None:
        """Put the start of an environment's next episode into the state tensors.

        Raises:
            ValueError: the task draws a wrong shape, or what is not finite or no
                rotation.
        """
        start = self._task.sample_start(self._seeds.next_generator(env))
        # As arrays: to index tensors takes three times as long.
        row = {key: value.numpy()[env] for key, value in self.state().items()}
        row["step_count"][:] = 0
        _fill(row["desired_goal"], start.goal, self._drawn_by("sample_goal"))
        row["joint_position"][:] = self._robot.neutral_joint_position
        row["joint_velocity"][:] = 0.0
        if len(row["object_pose"]):
            function = self._drawn_by("sample_objects")
            _fill(row["object_pose"], start.object_pose, function)
            for *_, x, y, z, w in row["object_pose"].tolist():
                if abs(math.hypot(x, y, z, w) - 1) > QUATERNION_TOLERANCE:
                    raise ValueError(
                        f"{function} must return unit quaternions, got {[x, y, z, w]}"
                    )
            row["object_velocity"][:] = 0.0
        if "object_joint_position" in row:
            joints = row["object_joint_position"]
            drawn = np.asarray(start.object_joint_position)
            drawn = np.broadcast_to(drawn, joints.shape) if drawn.size == 1 else drawn
            _fill(joints, drawn, self._drawn_by("sample_object_joints"))
            row["object_joint_velocity"][:] = 0.0
        if self._variation.is_on:
            self._variation.draw(env, self._seeds.physics_seed(env))

    def check_goal(self, goal: Tensor, envs: list[int]) -> Tensor:
        """Where markers show goals (k, goal_dim) of these environments, (k, m, 7).

        Raises:
            ValueError: a goal turns its marker by what is no rotation.
        """
        pose = self._task.marker_pose(goal)
        if type(self._task).marker_pose is not Task.marker_pose:
            check_rotations("desired_goal", pose, envs)
        return pose

    def check_physics(self, values: dict[str, Tensor], envs: list[int]) -> None:
        """Make sure that a state of these environments, (k, ...), has possible physics.

        Raises:
            ValueError: a factor is negative, or one of a mass is 0: what weighs 0 never
                moves.
        """
        if PHYSICS_PARAMETERS in values:
            factors = values[PHYSICS_PARAMETERS]
            is_possible = (factors > 0) | (factors == 0) & ~self._variation.is_mass
            wanted = "at least 0, of a mass above 0"
            check_rows(PHYSICS_PARAMETERS, is_possible, envs, wanted)

    def mark(self, envs: list[int]) -> None:
        """Say where markers are to be put: where the goals are; see `check_goal`."""
        if self._simulation.scene.markers:
            self._simulation.marker_pose[envs] = self.check_goal(self.goal[envs], envs)

    def place(self, envs: list[int]) -> None:
        """Put robots, objects and markers where the state tensors say."""
        varies = self._variation.changes_physics
        self._simulation.reset(envs, self._variation.apply if varies else None)

    def _drawn_by(self, function: str) -> str:
        return "sample_start" if self._own else function


def _fill(row: Doubles, values: object, function: str) -> None:
    """Take what a task has drawn for one environment, (...)."""
    drawn = np.asarray(values, dtype=np.float64)
    if drawn.shape != row.shape or not np.isfinite(drawn).all():
        raise ValueError(
            f"{function} must return finite numbers of shape {row.shape}, got {values}"
        )
    row[:] = drawn
