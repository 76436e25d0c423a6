"""Goals that are full observations, for ``RobotTaskEnv(goal="observation")``."""

from collections.abc import Callable, Sequence
from typing import Literal

import torch
from torch import Tensor

from torch_panda.bullet import (
    PhysicsClient,
    PhysicsParams,
    Scene,
    SimulationState,
    VectorSimulation,
)
from torch_panda.checks import check_choice
from torch_panda.robots import Robot
from torch_panda.rotations import euler_angles
from torch_panda.tasks import Task
from torch_panda.tasks.base import ObjectState, RewardFunction

GoalName = Literal["task", "observation"]


def find_goal_indices(robot: Robot, task: Task) -> tuple[int, ...] | None:
    """Columns of the observation that hold the achieved goal.

    Returns:
        ``goal_dim`` columns. None if the task does not declare ``goal_entries``, or if
        a subclass overrides a function that the declaration describes.

    Raises:
        ValueError: The part of ``goal_entries`` is neither "robot" nor "task".
    """
    entries = task.goal_entries
    if entries is None or not _is_up_to_date(task):
        return None
    check_choice("part of goal_entries", entries.part, ("robot", "task"))
    if entries.part == "robot" and type(robot).observation is not Robot.observation:
        return None
    offset = robot.observation_dim if entries.part == "task" else 0
    return tuple(offset + index for index in entries.indices)


def _is_up_to_date(task: Task) -> bool:
    """Whether ``goal_entries`` still describes the task's functions.

    A subclass may override ``observation`` or ``achieved_goal``. Then it must also
    declare ``goal_entries`` again, because the inherited indices may be wrong.
    """
    classes = type(task).__mro__
    declared, observation, achieved_goal = (
        next(level for level, base in enumerate(classes) if name in vars(base))
        for name in ("goal_entries", "observation", "achieved_goal")
    )
    return declared <= observation and declared <= achieved_goal


def apply_to_observations(
    function: RewardFunction,
    goal_indices: tuple[int, ...],
    observation_dim: int,
    achieved_goal: Tensor,
    desired_goal: Tensor,
) -> Tensor:
    """Apply a function of the task's goals to goals that are full observations.

    Args:
        function: The function of two goals, (..., goal_dim) each.
        goal_indices: Columns of an observation that hold the task's goal.
        observation_dim: Size of an observation.
        achieved_goal: (..., observation_dim).
        desired_goal: (..., observation_dim).

    Returns:
        The result of the function, (..., 1).

    Raises:
        ValueError: A goal is not a full observation.
    """
    sizes = (observation_dim,)
    if achieved_goal.shape[-1:] != sizes or desired_goal.shape[-1:] != sizes:
        raise ValueError(
            f"achieved_goal and desired_goal must be full observations of shape "
            f"(..., {observation_dim}), got {tuple(achieved_goal.shape)} and "
            f"{tuple(desired_goal.shape)}"
        )
    indices = list(goal_indices)
    return function(achieved_goal[..., indices], desired_goal[..., indices])


class GoalObserver:
    """Observes the states in which the desired goals are reached.

    In such a state the objects are at their goals and at rest. The hand is in its
    neutral pose, or at the goal if the goal is a position of the hand.

    The functions of robot and task observe these states as a second simulation, which
    shares the clients of the first one, but not its tensors.

    Raises:
        ValueError: The task needs an `Task.objects_at_goal` of its own.

    Attributes:
        desired: Observations of the present episodes' goals, (n, observation_dim)
            float32.
    """

    def __init__(
        self,
        robot: Robot,
        task: Task,
        simulation: VectorSimulation,
        build_scene: Callable[[PhysicsClient], Scene],
        physics: PhysicsParams,
        goal_indices: tuple[int, ...],
    ) -> None:
        self._robot, self._task, self._simulation = robot, task, simulation
        self._at_goal = simulation.with_state(
            SimulationState(simulation.scene, simulation.num_envs)
        )
        start = ObjectState(simulation.object_pose, simulation.object_joint_position)
        goal = start.pose.new_zeros(simulation.num_envs, task.goal_dim)
        try:
            task.objects_at_goal(goal, start)
        except NotImplementedError as error:
            raise ValueError(str(error)) from None
        self._goal_indices = list(goal_indices)
        self._hand_pose = _neutral_hand_pose(robot, build_scene, physics)
        size = robot.observation_dim + task.observation_dim
        self.desired = torch.zeros(
            simulation.num_envs, size, dtype=torch.float32, device="cpu"
        )

    def update(self, envs: Sequence[int], goal: Tensor) -> None:
        """Observe the goals of episodes that start.

        Args:
            envs: The environments whose episodes start. The tensors of the simulation
                hold the poses of their objects.
            goal: Desired goals of all environments, (n, goal_dim) float64.
        """
        self._write_goal_states(list(envs), goal)
        parts = (
            self._robot.observation(self._at_goal),
            self._task.observation(self._at_goal),
        )
        observation = torch.cat(parts, dim=1)
        desired = observation[envs].float()
        # Insert the goal itself. The observation may have rounded it. For goals of the
        # hand (Reach), the observation still holds the neutral pose.
        desired[:, self._goal_indices] = goal[envs].float()
        self.desired[envs] = desired

    def _write_goal_states(self, envs: list[int], goal: Tensor) -> None:
        """Write the states in which the goals are reached into `_at_goal`."""
        start, at_goal = self._simulation, self._at_goal
        objects = self._task.objects_at_goal(
            goal[envs],
            ObjectState(start.object_pose[envs], start.object_joint_position[envs]),
        )
        # Everything else, such as velocities, stays 0.
        neutral = goal.new_tensor(self._robot.neutral_joint_position)
        at_goal.joint_position[envs] = neutral
        at_goal.ee_position[envs] = self._hand_pose[:3]
        at_goal.ee_orientation[envs] = self._hand_pose[3:]
        at_goal.object_pose[envs] = objects.pose
        at_goal.object_joint_position[envs] = objects.joint_position
        at_goal.object_state[envs, :, :3] = objects.pose[..., :3]
        for env, poses in zip(envs, objects.pose.tolist(), strict=True):
            for index, pose in enumerate(poses):
                angles = goal.new_tensor(euler_angles(*pose[3:]))
                at_goal.object_euler[env, index] = angles


def _neutral_hand_pose(
    robot: Robot,
    build_scene: Callable[[PhysicsClient], Scene],
    physics: PhysicsParams,
) -> Tensor:
    """Pose of the end-effector while the joints are neutral, (7,) float64."""
    with PhysicsClient(physics=physics) as client:
        scene = build_scene(client)
        for joint, position in zip(
            scene.joints, robot.neutral_joint_position, strict=True
        ):
            client.set_joint(scene.robot, joint, position, 0.0)
        state = client.state(scene.robot)
        pose = list(state.link_pose(scene.ee_link))
    return torch.tensor(pose, dtype=torch.float64, device="cpu")
