"""Checks of a task of your own: `check_task`."""

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torch_panda.bullet import PhysicsClient, VectorSimulation
from torch_panda.checks import check_instance
from torch_panda.envs import RobotTaskEnv
from torch_panda.envs.goal_observation import find_goal_indices
from torch_panda.envs.task_problems import (
    Function,
    describe_error,
    find_goal_entries_problems,
    find_tensor_problems,
    list_functions,
)
from torch_panda.registry import find_registration
from torch_panda.robots import Panda, Robot
from torch_panda.rotations import NO_ROTATION
from torch_panda.sensors import Sensor
from torch_panda.tasks import Bodies, Start, Task
from torch_panda.tasks.base import RewardFunction

_NUM_ENVS, _NUM_EPISODES, _NUM_STEPS = 2, 3, 15
# Results may differ by this much, because sums in other shapes are rounded otherwise.
_ROUNDING = 1e-5


def check_task(
    task: str | Task,
    *,
    robot: Robot | None = None,
    sensors: Sequence[Sensor | str] = (),
) -> None:
    """Check the functions of a task, and list everything that is wrong with them.

    The check copies the task and the robot, and plays short episodes with random
    actions in environments of its own. It reports:

    * tensors of a wrong shape or dtype, NaN and infinity (entries of
      `Task.extra_observation` and `Task.info` may be infinite), and keys that change;
    * functions that change goals or the state of the simulation in place;
    * `Task.is_success` and `Task.compute_reward`, if a result depends on anything but
      its pair of goals, such as the other goals of the batch;
    * an observation that does not hold the achieved goal where ``goal_entries`` says;
    * episodes that differ although they have the same seed and the same actions;
    * sensors that observe other entries than they declare, or that later overwrite the
      tensors that they returned.

    Args:
        task: An id, or a task.
        robot: The robot; None means the robot of the id, or a `Panda` for a task.
        sensors: Sensors that are checked, too.

    Raises:
        ValueError: There are problems. The message has one line for each.
        TypeError: The task or the robot is of another type, such as a class.
    """
    if isinstance(task, str):
        registration = find_registration(task)
        task = registration.make_task()
        robot = registration.make_robot() if robot is None else robot
    robot = Panda() if robot is None else robot
    check_instance("task", task, Task)
    check_instance("robot", robot, Robot)
    check = _TaskCheck(copy.deepcopy(task), copy.deepcopy(robot))
    if problems := check.find_problems(sensors):
        raise ValueError("\n".join(problems)) from check.error
    # Every environment of the task refuses the remaining problems, such as a reserved
    # key.
    with RobotTaskEnv(
        robot=copy.deepcopy(robot),
        task=copy.deepcopy(task),
        num_envs=_NUM_ENVS,
        seed=0,
        sensors=sensors,
    ) as env:
        for _ in _play(env):
            pass


class _Scene(Task):
    """Scene and starts of a task, but with goals and observations that are all zero.

    An environment of it can step, whatever the functions of the task return.
    """

    observation_dim = 0

    def __init__(self, task: Task) -> None:
        super().__init__()
        self._task = task
        self._num_markers = 0

    def build(self, client: PhysicsClient) -> Bodies:
        bodies = self._task.build(client)
        if isinstance(bodies, Bodies):  # else the environment refuses it
            self._num_markers = len(bodies.markers)
        return bodies

    def sample_start(self, rng: np.random.Generator) -> Start:
        return self._task.sample_start(rng)

    def randomize(
        self, client: PhysicsClient, bodies: Bodies, rng: np.random.Generator
    ) -> None:
        self._task.randomize(client, bodies, rng)

    def marker_pose(self, goal: Tensor) -> Tensor:
        pose = goal.new_tensor((0.0, 0.0, 0.0, *NO_ROTATION))
        return pose.expand(*goal.shape[:-1], self._num_markers, 7)

    def achieved_goal(self, simulation: VectorSimulation) -> Tensor:
        return simulation.ee_position.new_zeros(simulation.num_envs, self.goal_dim)


def _with_base_observation(robot: Robot) -> Robot:
    """A copy of a robot whose observation always works, as that of `_Scene`."""
    functions = {name: vars(Robot)[name] for name in ("observation", "observation_dim")}
    twin = copy.copy(robot)
    twin.__class__ = type(type(robot).__name__, (type(robot),), functions)
    return twin


class _TaskCheck:
    """Plays episodes in the scene of a task, and calls the functions of the task.

    Attributes:
        error: The first error that a function raised, or None.
    """

    def __init__(self, task: Task, robot: Robot) -> None:
        self._task, self._robot = task, robot
        self._name = type(task).__name__
        self._goal_indices = find_goal_indices(robot, task)
        # Lines by function. A function that has a problem is not called again.
        self._problems: dict[str, list[str]] = {}
        # Achieved and desired goals of the episodes, (n, goal_dim) each.
        self._goals: list[tuple[Tensor, Tensor]] = []
        # Entries of the first call of a hook, by the hook's name.
        self._hook_entries: dict[
            str, dict[str, tuple[tuple[int, ...], torch.dtype]]
        ] = {}
        self.error: Exception | None = None

    def find_problems(self, sensors: Sequence[Sensor | str]) -> list[str]:
        """Play episodes, and return the problems, one line each."""
        task, name = self._task, f"{self._name}.goal_entries"
        self._set(
            name, *find_goal_entries_problems(self._robot, task, self._goal_indices)
        )
        # The class has the name of the task, because it appears in errors.
        scene_class = type(self._name, (_Scene,), {"goal_dim": task.goal_dim})
        with RobotTaskEnv(
            robot=_with_base_observation(self._robot),
            task=scene_class(task),
            num_envs=_NUM_ENVS,
            seed=0,
            sensors=sensors,
            on_divergence="reset",
        ) as env:
            # Call the functions before the first reset, because it may fail.
            self._check_functions(env, None, has_started=False)
            self._attempt("an episode", lambda: self._check_episodes(env))
        self._check_goal_functions()
        return [line for lines in self._problems.values() for line in lines]

    def _check_episodes(self, env: RobotTaskEnv) -> None:
        """Check what functions and sensors return, and that episodes repeat."""
        begin = env.state_dict()
        states, outputs = [], []
        for action, output in _play(env):
            self._check_functions(env, action, has_started=True)
            self._check_sensors(env, output)
            states.append(env.get_state())
            outputs.append((output, output.clone()))
        for key in env.episodes.entries:
            for output, copied in outputs:
                value, expected = output.get(key, None), copied.get(key, None)
                if value is not None and not _is_equal(value, expected):
                    self._set(
                        f"sensor {key}",
                        f"a sensor must return new tensors, but a later step overwrote "
                        f"{key!r}: return a copy, such as tensor.clone()",
                    )
        env.load_state_dict(begin)
        for state, _ in zip(states, _play(env), strict=True):
            self._compare_states(state, env.get_state())

    def _check_functions(
        self, env: RobotTaskEnv, action: Tensor | None, *, has_started: bool
    ) -> None:
        """Call all functions in the present state of the environments."""
        robot, simulation = self._robot, env.episodes.simulation
        goals = self._read_goals(env) if has_started else None
        values: dict[str, Any] = {}
        for function in list_functions(
            robot, self._task, simulation, action=action, goals=goals
        ):
            name = function.name
            if name in self._problems:
                continue
            value, problems = self._attempt(name, function.check) or (None, [])
            if not problems and function.is_hook and value is not None:
                problems = self._find_changed_entries(name, value)
            # Before the first reset, the state is all zero.
            if not problems and has_started and value is not None:
                problems = _find_wrong_numbers(function, value)
            self._set(name, *problems)
            if name not in self._problems:
                values[name] = value
        if has_started and self._goal_indices is not None:
            self._check_goal_entries(values, list(self._goal_indices))

    def _check_goal_entries(self, values: dict[str, Any], indices: list[int]) -> None:
        """Compare the achieved goal with the columns of the observation that hold it.

        Args:
            values: What the functions returned, without those that have problems.
            indices: The columns.
        """
        name = f"{self._name}.goal_entries"
        observation = [
            f"{type(self._robot).__name__}.observation",
            f"{self._name}.observation",
        ]
        goal = f"{self._name}.achieved_goal"
        if name in self._problems or not values.keys() >= {*observation, goal}:
            return
        numbers = torch.cat([values[part] for part in observation], dim=1)[:, indices]
        achieved_goal = values[goal]
        if not torch.allclose(numbers.float(), achieved_goal.float()):
            self._set(
                name,
                f"the columns {indices} of the observation must be the achieved goal, "
                f"as {name} says, but they differ: {numbers[0].tolist()} and "
                f"{achieved_goal[0].tolist()}",
            )

    def _read_goals(self, env: RobotTaskEnv) -> tuple[Tensor, Tensor]:
        """Achieved and desired goals, (n, goal_dim) float32, for functions of goals."""
        desired_goal = env.get_state()["desired_goal"].float()
        achieved_goal = torch.zeros_like(desired_goal)
        name = f"{self._name}.achieved_goal"
        if name not in self._problems:
            read = partial(self._task.achieved_goal, env.episodes.simulation)
            value = self._attempt(name, read)
            if isinstance(value, Tensor) and value.shape == desired_goal.shape:
                achieved_goal = value.to(torch.float32, copy=True)
        self._goals.append((achieved_goal, desired_goal))
        return achieved_goal.clone(), desired_goal.clone()

    def _find_changed_entries(self, name: str, value: dict[str, Tensor]) -> list[str]:
        """Compare the entries of a hook with the entries of its first call."""
        entries = {key: (tuple(x.shape), x.dtype) for key, x in value.items()}
        first = self._hook_entries.setdefault(name, entries)
        if entries == first:
            return []
        return [f"{name} must always return the entries {first}, got {entries}"]

    def _check_sensors(self, env: RobotTaskEnv, output: TensorDictBase) -> None:
        """Compare the observed entries of sensors with the declared ones."""
        for key, entry in env.episodes.entries.items():
            name = f"sensor {key}"
            if name not in self._problems:
                value, shape = output.get(key, None), (_NUM_ENVS, *entry.shape)
                text = f"the sensor that declares {key!r}"
                self._set(name, *find_tensor_problems(text, value, shape, entry.dtype))

    def _compare_states(self, state: TensorDictBase, repeated: TensorDictBase) -> None:
        """Compare the states of two episodes of one seed after the same actions."""
        name = f"{self._name}.sample_start and randomize"
        if name in self._problems or (state == repeated).all():
            return
        line = (
            f"two episodes with the same rng, start and actions differ: "
            f"{self._name}.randomize must draw from rng alone"
        )
        if not state["step_count"].any():
            line = (
                f"two episodes with the same rng start differently: "
                f"{self._name}.sample_start, sample_goal, sample_objects and "
                f"sample_object_joints must draw from rng alone"
            )
        self._set(name, line)

    def _check_goal_functions(self) -> None:
        """Check that the functions of goals are pure."""
        goals = self._goals
        if not goals:  # no episode could start
            shape = (2, _NUM_ENVS, self._task.goal_dim)
            first, second = torch.linspace(
                0.1, 0.9, math.prod(shape), device="cpu"
            ).view(shape)
            goals = [(first, second)]
        achieved, desired = (torch.cat(x) for x in zip(*goals, strict=True))
        # The second half are successes.
        achieved, desired = torch.cat((achieved, desired)), desired.repeat(2, 1)
        for name, function in (
            (f"{self._name}.is_success", self._task.is_success),
            (f"{self._name}.compute_reward", self._task.compute_reward),
        ):
            if name not in self._problems:
                find = partial(_find_impurity, name, function, achieved, desired)
                self._set(name, *self._attempt(name, find) or [])

    def _set(self, name: str, *problems: str) -> None:
        """Note the problems of a function, if there are any."""
        if problems:
            self._problems[name] = list(problems)

    def _attempt(self, name: str, call: Callable[[], Any]) -> Any:  # noqa: ANN401
        """Return what a function returns, or note its error and return None."""
        try:
            return call()
        except Exception as error:
            self.error = self.error or error
            self._set(name, describe_error(name, error))
            return None


def _play(env: RobotTaskEnv) -> Iterator[tuple[Tensor | None, TensorDictBase]]:
    """Play episodes with random actions, the same in each call.

    Yields:
        The action, (n, action_dim), or None after a reset; and the output.
    """
    generator = torch.Generator("cpu").manual_seed(0)
    shape = env.action_spec.shape
    for _ in range(_NUM_EPISODES):
        output: TensorDictBase = env.reset()
        yield None, output
        for _ in range(_NUM_STEPS):
            action = 2 * torch.rand(shape, generator=generator, device="cpu") - 1
            stepped = env.step(output.clone().set("action", action))
            output = stepped.get("next")
            yield action, output


def _find_wrong_numbers(function: Function, value: Any) -> list[str]:  # noqa: ANN401
    """Find NaN in entries of hooks, and NaN and infinity in other tensors."""
    entries = {function.name: value}
    requirement = "finite numbers"
    if function.is_hook:  # a distance to something unseen may be infinite
        entries = {f"{function.name}[{key!r}]": entry for key, entry in value.items()}
        requirement = "no NaN"
    problems = []
    for name, tensor in entries.items():
        is_wrong = tensor.isnan() if function.is_hook else ~tensor.isfinite()
        if is_wrong.any():
            env = int(is_wrong.flatten(1).any(dim=1).nonzero()[0])
            problems.append(
                f"{name} must return {requirement}, but returned "
                f"{tensor[env].tolist()} for environment {env}: look for a division by "
                f"0 or a root of a negative number"
            )
    return problems


def _find_impurity(
    name: str, function: RewardFunction, achieved: Tensor, desired: Tensor
) -> list[str]:
    """Compare the results of a function of goals, (2 * k, goal_dim), with each other.

    Args:
        name: Name of the function.
        function: The function.
        achieved: Achieved goals.
        desired: Desired goals.
    """
    result = function(achieved, desired)
    kept = result.clone()
    function(achieved.flip(0), desired)  # may overwrite `result`
    is_overwritten = not _is_equal(result, kept)
    again = function(achieved, desired).clone()
    pairs = zip(achieved, desired, strict=True)
    rows = torch.stack([function(*pair).clone() for pair in pairs])
    halves = function(achieved.unflatten(0, (2, -1)), desired.unflatten(0, (2, -1)))
    problems = []
    if not kept.isfinite().all():
        problems.append(
            f"{name} must return finite numbers for all goals, also for equal ones, "
            f"which hindsight gives"
        )
    if not _is_equal(again, kept):
        problems.append(
            f"{name} must depend on its arguments alone, but returned different "
            f"results for the same goals"
        )
    elif not all(_is_equal(x, kept, _ROUNDING) for x in (rows, halves.flatten(0, 1))):
        problems.append(
            f"{name} must map goals (..., {achieved.shape[1]}) to (..., 1), each pair "
            f"of goals alone, but returned other results for the same goals in batches "
            f"of other shapes"
        )
    if is_overwritten:
        problems.append(
            f"{name} must return new tensors, but its next call overwrote its result: "
            f"return a copy, such as tensor.clone()"
        )
    return problems


def _is_equal(values: Tensor, expected: Tensor, tolerance: float = 0.0) -> bool:
    """Whether tensors have the same shape and numbers; NaN equals NaN."""
    return values.shape == expected.shape and torch.allclose(
        values.double(),
        expected.double(),
        rtol=tolerance,
        atol=tolerance,
        equal_nan=True,
    )
