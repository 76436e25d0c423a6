"""Computes observations, goals, success, reward and end flags in C."""

import torch
from torch import Tensor

from torch_panda.bullet import VectorSimulation, native
from torch_panda.bullet.native_loop import ints
from torch_panda.bullet.selection import selected_columns
from torch_panda.robots import Robot
from torch_panda.robots.compiled_setpoints import has_compiled_width
from torch_panda.tasks import Task

Observed = dict[str, Tensor]
"""Observed entries of all environments, (n, ...) by key, in new tensors."""

# If a task overrides none of these methods, its success and its sparse reward depend on
# the distance of the two goals only, and C code can compute them.
_DISTANCE_METHODS = ("distance", "success_distance", "is_success", "compute_reward")


class CompiledObserver:
    """Computes in C the numbers that functions of robot and task compute in torch.

    Args:
        robot: The robot.
        task: The task.
        simulation: The environments, which the native loop steps.
        columns: Columns of ``simulation.state.rows`` that make up the observation.
        goal_columns: Columns that make up the achieved goal.
        max_episode_steps: Number of steps after which an episode is ``truncated``.
        terminate_on_success: Whether success ends an episode.
    """

    def __init__(
        self,
        robot: Robot,
        task: Task,
        simulation: VectorSimulation,
        *,
        columns: tuple[int, ...],
        goal_columns: tuple[int, ...],
        max_episode_steps: int,
        terminate_on_success: bool,
    ) -> None:
        assert native.LIBRARY is not None
        self._task, self._library = task, native.LIBRARY
        self._state = simulation.state.rows
        self._state_address = self._state.data_ptr()
        n, row_size = self._state.shape
        self._description = native.Observation(
            row_size=row_size,
            size=len(columns),
            goal_size=len(goal_columns),
            columns=ints(columns),
            goal_columns=ints(goal_columns),
            compares_distance=all(
                getattr(type(task), name) is getattr(Task, name)
                for name in _DISTANCE_METHODS
            ),
            terminate_on_success=terminate_on_success,
            max_episode_steps=max_episode_steps,
        )
        if robot.gripper is not None and robot.has_free_gripper:
            self._description.gripper = robot.gripper.describe(robot.num_arm_joints)
        observation, goal, flag = (
            torch.empty(n, len(columns), dtype=torch.float32, device="cpu"),
            torch.empty(n, len(goal_columns), dtype=torch.float32, device="cpu"),
            torch.empty(n, 1, dtype=torch.bool, device="cpu"),
        )
        # In the order of the arguments of `environment_observe`.
        self._templates = {
            "observation": observation,
            "achieved_goal": goal,
            "desired_goal": goal,
            "reward": observation[:, :1].clone(),
            "success": flag,
            "terminated": flag,
            "truncated": flag,
            "done": flag,
        }

    @classmethod
    def make(
        cls,
        robot: Robot,
        task: Task,
        simulation: VectorSimulation,
        *,
        max_episode_steps: int,
        terminate_on_success: bool,
    ) -> "CompiledObserver | None":
        """An observer for this robot and task, or None if C cannot observe them."""
        if not simulation.is_native:
            return None
        robot_columns = _robot_columns(robot, simulation)
        task_columns = selected_columns(task.observation, simulation)
        goal_columns = selected_columns(task.achieved_goal, simulation)
        if robot_columns is None or task_columns is None or goal_columns is None:
            return None
        return cls(
            robot,
            task,
            simulation,
            columns=(*robot_columns, *task_columns),
            goal_columns=goal_columns,
            max_episode_steps=max_episode_steps,
            terminate_on_success=terminate_on_success,
        )

    def observe(self, goal: Tensor, step_count: Tensor) -> tuple[Observed, bool]:
        """Observe all environments.

        Args:
            goal: Desired goals, (n, goal_dim) float64.
            step_count: Number of steps of the present episodes, (n, 1) int64.

        Returns:
            The observed entries and the reward; and whether reward, success and end
            flags are valid. They are not valid if the task overrides one of
            `_DISTANCE_METHODS`, if the reward is dense, or if a distance is so close to
            the threshold that torch may round it to the other side.
        """
        observed = {key: torch.empty_like(t) for key, t in self._templates.items()}
        description, task = self._description, self._task
        description.distance_threshold = task.distance_threshold
        has_outcome = self._library.environment_observe(
            description,
            self._state_address,
            len(goal),
            goal.data_ptr(),
            step_count.data_ptr(),
            *[value.data_ptr() for value in observed.values()],
        )
        return observed, has_outcome and task.reward_type == "sparse"


def _robot_columns(
    robot: Robot, simulation: VectorSimulation
) -> tuple[int, ...] | None:
    """Columns of `Robot.observation`, or None if C cannot compute it."""
    robot_class = type(robot)
    if (
        robot_class.observation is not Robot.observation
        or robot_class.fingers_width is not Robot.fingers_width
    ):
        return selected_columns(robot.observation, simulation)
    # `Robot.observation` has the position and velocity of the end-effector and, with a
    # free gripper, the distance between the fingers. WIDTH is not a column: it tells C
    # code to compute this distance.
    first = simulation.state.ee_column
    columns = tuple(range(first, first + 6))
    if not robot.has_free_gripper:
        return columns
    return (*columns, native.WIDTH) if has_compiled_width(robot) else None
