"""Drawing the start of an episode."""

import math

import numpy as np
import torch
from torch import Tensor

from torch_panda.bullet import VectorSimulation
from torch_panda.envs.state import QUATERNION_TOLERANCE
from torch_panda.robots import Robot
from torch_panda.tasks import Task


def draw_start(
    env: int,
    rng: np.random.Generator,
    robot: Robot,
    task: Task,
    simulation: VectorSimulation,
    goal: Tensor,
) -> None:
    """Put the start of an environment's next episode into the state tensors.

    Args:
        env: which environment.
        rng: of this episode.
        robot: starts neutral.
        task: draws goal, objects and their joints.
        simulation: receives the state.
        goal: (n, goal_dim), receives the goal.

    Raises:
        ValueError: the task draws a wrong shape, or what is not finite or no rotation.
    """
    own = type(task).sample_start is not Task.sample_start
    start = task.sample_start(rng)
    _fill(goal[env], start.goal, "sample_start" if own else "sample_goal")
    simulation.joint_position[env] = _double(robot.neutral_joint_position)
    simulation.joint_velocity[env] = 0.0
    if simulation.scene.objects:
        function = "sample_start" if own else "sample_objects"
        pose = simulation.object_pose
        _fill(pose[env], start.object_pose, function)
        for *_, x, y, z, w in pose[env].tolist():
            if abs(math.hypot(x, y, z, w) - 1) > QUATERNION_TOLERANCE:
                raise ValueError(
                    f"{function} must return unit quaternions, got {[x, y, z, w]}"
                )
        simulation.object_velocity[env] = 0.0
    if any(simulation.scene.object_joints):
        joints = simulation.object_joint_position[env]
        drawn = _double(start.object_joint_position)
        drawn = drawn.expand_as(joints) if drawn.shape == (1,) else drawn
        _fill(joints, drawn, "sample_start" if own else "sample_object_joints")
        simulation.object_joint_velocity[env] = 0.0


def _double(values: object) -> Tensor:
    return torch.as_tensor(values, dtype=torch.float64, device="cpu")


def _fill(row: Tensor, values: object, function: str) -> None:
    """Take what a task has drawn for one environment, (...)."""
    drawn = _double(values)
    if drawn.shape != row.shape or not drawn.isfinite().all():
        raise ValueError(
            f"{function} must return finite numbers of shape {tuple(row.shape)}, "
            f"got {values}"
        )
    row.copy_(drawn)
