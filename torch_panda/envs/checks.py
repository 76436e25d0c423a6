"""What an environment is made of, checked before it runs."""

import sys

import torch
from torch import Tensor

from torch_panda.bullet import VectorSimulation
from torch_panda.envs.seeds import integer
from torch_panda.robots import Robot
from torch_panda.tasks import Task


def check_positive(**arguments: int | None) -> None:
    """Make sure that numbers are from 1 on, or None.

    Raises:
        ValueError: one is not.
        TypeError: one is no integer.
    """
    for name, value in arguments.items():
        if value is not None and not 1 <= integer(name, value) <= sys.maxsize:
            raise ValueError(
                f"{name} must be None or from 1 to {sys.maxsize}, got {value}"
            )


def check_device(device: torch.device | str | int | None) -> torch.device:
    """A device that works.

    Raises:
        RuntimeError: torch knows no such device.
    """
    device = torch.device("cpu" if device is None else device)
    try:
        torch.empty(0, device=device)
    except AssertionError as error:  # torch was built without it
        raise RuntimeError(f"device {device} does not work: {error}") from None
    return device


def check_kinds(robot: object, task: object) -> None:
    """Make sure that a robot and a task were given.

    Raises:
        TypeError: they are something else, each other, or classes.
    """
    for name, value, kind in (("robot", robot, Robot), ("task", task, Task)):
        if not isinstance(value, kind):
            given = f"the class {value.__name__}" if isinstance(value, type) else value
            raise TypeError(
                f"{name} must be an instance of {kind.__name__}, got {given}"
            )


def check_functions(
    robot: Robot, task: Task, simulation: VectorSimulation, goal: Tensor
) -> None:
    """Make sure that robot and task give as many numbers as they say.

    Args:
        robot: the robot.
        task: the task.
        simulation: holds them.
        goal: (n, goal_dim) float64.

    Raises:
        ValueError: a shape or a dtype is another one.
        TypeError: something is no tensor.
    """
    n = simulation.num_envs
    for owner, name, size in (
        (robot, "observation", robot.observation_dim),
        (task, "observation", task.observation_dim),
        (task, "achieved_goal", task.goal_dim),
    ):
        check_result(owner, name, getattr(owner, name)(simulation), (n, size))
    if simulation.scene.markers:
        shape = (n, len(simulation.scene.markers), 7)
        check_result(task, "marker_pose", task.marker_pose(goal), shape)
    goals = task.achieved_goal(simulation).float(), goal.float()
    check_result(task, "compute_reward", task.compute_reward(*goals), (n, 1))
    check_result(task, "is_success", task.is_success(*goals), (n, 1), torch.bool)


def check_result(
    owner: object,
    name: str,
    value: object,
    shape: tuple[int, ...],
    dtype: torch.dtype | None = None,
) -> None:
    """Make sure that a function of a robot or task gives such a tensor.

    Raises:
        ValueError: it has another shape or dtype.
        TypeError: it is no tensor.
    """
    function = f"{type(owner).__name__}.{name}"
    if not isinstance(value, Tensor):
        raise TypeError(f"{function} must return a tensor, got {value!r}")
    if tuple(value.shape) != shape:
        raise ValueError(
            f"{function} must return shape {shape}, got {tuple(value.shape)}"
        )
    if dtype is not None and value.dtype != dtype:
        kind = str(dtype).removeprefix("torch.")
        raise ValueError(f"{function} must return {kind}, got {value.dtype}")
