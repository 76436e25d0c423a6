"""Problems of the functions of a robot and a task: wrong tensors, changes in place."""

import copy
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_panda.bullet import VectorSimulation
from torch_panda.robots import Robot
from torch_panda.tasks import Task
from torch_panda.tasks.base import SAMPLERS

# Number of starts that `find_uncalled_samplers` draws.
_NUM_PROBES = 100


class Function(NamedTuple):
    """A function of a robot or a task, and the tensors that it must return.

    Attributes:
        name: Name of the function, for the descriptions of problems.
        call: Calls the function with its arguments.
        shape: Shape of the returned tensor.
        dtype: dtype of the returned tensor; None accepts any.
        is_hook: Whether the function returns a dict of tensors instead of one tensor.
            Then ``shape`` is the beginning of their shapes.
        inputs: Tensors that the function must not change.
    """

    name: str
    call: Callable[[], Any]
    shape: tuple[int, ...]
    dtype: torch.dtype | None = None
    is_hook: bool = False
    inputs: tuple[Tensor, ...] = ()

    def check(self) -> tuple[Any, list[str]]:
        """Call the function.

        Returns:
            The returned value, and its problems, one line each.
        """
        # Changes in place increment this counter, also changes of a view of the tensor.
        versions = [tensor._version for tensor in self.inputs]
        value = self.call()
        problems = []
        if [tensor._version for tensor in self.inputs] != versions:
            problems.append(
                f"{self.name} must not change goals or the state of the simulation in "
                f"place: change a copy, such as tensor.clone()"
            )
        if not self.is_hook:
            problems += find_tensor_problems(self.name, value, self.shape, self.dtype)
        elif not isinstance(value, dict):
            problems.append(
                f"{self.name} must return a dict of tensors, got {_class(value)}"
            )
        else:
            for key, entry in value.items():
                tail = tuple(entry.shape[1:]) if isinstance(entry, Tensor) else ()
                name, shape = f"{self.name}[{key!r}]", (*self.shape, *tail)
                problems += find_tensor_problems(name, entry, shape)
        return value, problems


def list_functions(
    robot: Robot,
    task: Task,
    simulation: VectorSimulation,
    *,
    action: Tensor | None = None,
    goals: tuple[Tensor, Tensor] | None = None,
) -> list[Function]:
    """List the functions that an environment calls in resets and steps.

    Args:
        robot: The robot.
        task: The task. A hook that it does not override is left out.
        simulation: The environments.
        action: Argument of `Task.reward`, (n, action_dim); None means zeros.
        goals: Achieved and desired goals for the functions of goals, (n, goal_dim)
            each; None means zeros.
    """
    n = simulation.num_envs
    if action is None:
        action = torch.zeros(n, robot.action_dim, dtype=torch.float32, device="cpu")
    if goals is None:
        zeros = torch.zeros(n, task.goal_dim, dtype=torch.float32, device="cpu")
        goals = zeros, zeros.clone()

    def function(
        owner: Robot | Task,
        name: str,
        arguments: tuple[Any, ...],
        shape: tuple[int, ...],
        dtype: torch.dtype | None = None,
        is_hook: bool = False,
    ) -> Function:
        # An environment copies the action for `Task.reward`, which may change it.
        inputs = [x for x in arguments if isinstance(x, Tensor) and x is not action]
        if any(x is simulation for x in arguments):
            inputs.append(simulation.state.rows)
        call = partial(getattr(owner, name), *arguments)
        name = f"{type(owner).__name__}.{name}"
        return Function(name, call, shape, dtype, is_hook, tuple(inputs))

    functions = [
        function(robot, "observation", (simulation,), (n, robot.observation_dim)),
        function(task, "observation", (simulation,), (n, task.observation_dim)),
        function(task, "achieved_goal", (simulation,), (n, task.goal_dim)),
        function(task, "is_success", goals, (n, 1), torch.bool),
        function(task, "compute_reward", goals, (n, 1)),
    ]
    if markers := simulation.scene.markers:
        goal, shape = goals[1].double(), (n, len(markers), 7)
        functions.append(function(task, "marker_pose", (goal,), shape))
    state = (simulation,)
    hooks = {
        "reward": function(task, "reward", (simulation, action, *goals), (n, 1)),
        "failure": function(task, "failure", state, (n, 1), torch.bool),
        "extra_observation": function(
            task, "extra_observation", state, (n,), is_hook=True
        ),
        "info": function(task, "info", state, (n,), is_hook=True),
    }
    return functions + [
        hook
        for name, hook in hooks.items()
        if getattr(type(task), name) is not getattr(Task, name)
    ]


def find_problems(
    robot: Robot,
    task: Task,
    simulation: VectorSimulation,
    goal_indices: tuple[int, ...] | None,
) -> list[str]:
    """Compare the functions of a robot and a task with the sizes that they declare.

    Args:
        robot: The robot.
        task: The task.
        simulation: The environments.
        goal_indices: Columns of the observation that hold the achieved goal, or None.

    Returns:
        The problems, one line each.
    """
    problems: list[str] = []
    for function in list_functions(robot, task, simulation):
        try:
            problems += function.check()[1]
        except Exception as error:
            if not problems:
                raise
            # The problems that are known may be the cause, for example a wrong size.
            problems.append(describe_error(function.name, error))
    return problems + find_goal_entries_problems(robot, task, goal_indices)


def find_goal_entries_problems(
    robot: Robot, task: Task, goal_indices: tuple[int, ...] | None
) -> list[str]:
    """Compare `Task.goal_entries` with the sizes of goal and observation."""
    if goal_indices is None:
        return []
    size = robot.observation_dim + task.observation_dim
    is_inside = all(0 <= index < size for index in goal_indices)
    if len(goal_indices) == task.goal_dim and is_inside:
        return []
    return [
        f"{type(task).__name__}.goal_entries must name {task.goal_dim} numbers of an "
        f"observation, got {task.goal_entries}; the robot's part has "
        f"{robot.observation_dim} numbers, and the task's part has "
        f"{task.observation_dim}"
    ]


def find_uncalled_samplers(task: Task) -> list[str]:
    """Find methods that a task overrides, but that its `sample_start` never calls.

    `sample_start` and the other methods are called on copies of the task. If one of
    them fails, nothing is found.
    """
    if type(task).sample_start is Task.sample_start:
        return []
    unused = {
        name
        for name in SAMPLERS
        if _override_level(task, name) < _override_level(task, "sample_start")
    }
    if not unused:
        return []
    probe, original = copy.copy(task), copy.copy(task)

    def record(name: str, rng: np.random.Generator) -> object:
        unused.discard(name)
        return getattr(original, name)(rng)

    for name in unused:
        setattr(probe, name, partial(record, name))
    try:
        # `sample_start` may call a method in some of the episodes only.
        for seed in range(_NUM_PROBES):
            probe.sample_start(np.random.default_rng(seed))
    except Exception:
        return []
    if not unused:
        return []
    owner = type(task).__mro__[_override_level(task, "sample_start")].__name__
    return [
        f"{' and '.join(sorted(unused))} of {type(task).__name__} would never be "
        f"called, because {owner}.sample_start draws without "
        f"{'it' if len(unused) == 1 else 'them'}: override sample_start instead"
    ]


def _override_level(task: Task, name: str) -> int:
    """Index in the MRO of the class that defines a method; -1 for the object itself."""
    if name in vars(task):
        return -1
    classes = type(task).__mro__
    return next(level for level, base in enumerate(classes) if name in vars(base))


def find_tensor_problems(
    name: str,
    value: object,
    shape: tuple[int, ...],
    dtype: torch.dtype | None = None,
) -> list[str]:
    """Compare a returned value with the shape and the dtype that it must have.

    Args:
        name: Name of the function, for the descriptions of problems.
        value: The returned value.
        shape: The shape that the tensor must have.
        dtype: The dtype that the tensor must have; None accepts any.
    """
    if not isinstance(value, Tensor):
        return [f"{name} must return a tensor, got {_class(value)}"]
    problems = []
    if tuple(value.shape) != shape:
        problems.append(f"{name} must return shape {shape}, got {tuple(value.shape)}")
    if dtype is not None and value.dtype != dtype:
        expected = str(dtype).removeprefix("torch.")
        problems.append(f"{name} must return {expected}, got {value.dtype}")
    return problems


def describe_error(name: str, error: Exception) -> str:
    """Describe the error that a function raised, on one line."""
    return f"{name} raised {type(error).__name__}: {' '.join(str(error).split())}"


def _class(value: object) -> str:
    """Class of a value, on one line."""
    return "None" if value is None else f"a {type(value).__name__}"
