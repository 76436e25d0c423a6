"""Observes episodes: state, goals, sensors, reward, success, and how episodes end."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor

from torch_panda.bullet import VectorSimulation
from torch_panda.checks import check_output
from torch_panda.envs.randomization import PHYSICS_KEYS, DomainRandomizer
from torch_panda.envs.state import BODY_KEYS, EXACT_KEYS
from torch_panda.rendering import VectorRenderer
from torch_panda.robots import Robot
from torch_panda.sensors import Entry, JointState, Observer, Sensor, join_entries
from torch_panda.tasks import Task

# The first 20 observations are checked for NaN and infinity. The check is too expensive
# for every step.
_NUM_CHECKED = 20

Observed = dict[str, Tensor]
"""Observed entries of all environments, (n, ...) by key, in new tensors."""

Hook = Callable[[VectorSimulation], dict[str, Tensor]]
HOOKS = ("extra_observation", "info")
"""Hooks of `Task` that return entries by key."""

# Keys that Gymnasium and Stable-Baselines3 write into infos.
_GYMNASIUM_INFO_KEYS = {
    "is_success", "final_obs", "final_info", "terminal_observation", "episode",
    "TimeLimit.truncated",
}  # fmt: skip


class EpisodeObserver:
    """Observes n environments of one robot and one task.

    Raises:
        ValueError: A function of the robot or the task returns a wrong shape or dtype
            or changes goals or state, or two sensors observe the same entry.
        TypeError: A function of the robot or the task does not return a tensor.

    Attributes:
        entries: Shape and dtype of the keys that sensors, task and randomization add.
        info_keys: Keys among them that `Task.info` adds.
    """

    def __init__(
        self,
        robot: Robot,
        task: Task,
        simulation: VectorSimulation,
        renderer: VectorRenderer,
        *,
        sensors: Sequence[Sensor],
        randomizer: DomainRandomizer,
        goal_indices: tuple[int, ...] | None,
        max_episode_steps: int,
        terminate_on_success: bool,
    ) -> None:
        self._robot, self._task, self._simulation = robot, task, simulation
        self._max_episode_steps = max_episode_steps
        self._terminate_on_success = terminate_on_success
        self._goal_indices = None if goal_indices is None else list(goal_indices)
        self._num_to_check = _NUM_CHECKED
        # Kept while observations are checked, so that their memory is not used again.
        self._last_values: Observed = {}
        # A hook that the task does not override is never called.
        self._has_reward = type(task).reward is not Task.reward
        self._has_failure = type(task).failure is not Task.failure
        self._may_terminate = terminate_on_success or self._has_failure
        self._check_functions()
        # Sensors also follow resets and steps; the other observers only observe.
        self._attached_sensors = [
            sensor.attach(simulation, renderer, robot) for sensor in sensors
        ]
        hooks = [HookObserver(task, simulation, name) for name in HOOKS]
        # Functions of the task that return entries, by key; for errors.
        self._hook_keys = {key: hook.function for hook in hooks for key in hook.entries}
        self.info_keys = frozenset(hooks[HOOKS.index("info")].entries)
        if taken := self.info_keys & _GYMNASIUM_INFO_KEYS:
            raise ValueError(
                f"{type(task).__name__}.info must not return {sorted(taken)}, because "
                f"Gymnasium and Stable-Baselines3 use these keys"
            )
        observers: list[Observer] = [*self._attached_sensors, *hooks]
        # Keys of states, which sensors and tasks may not observe. Only the sensor
        # "joint_state" may use two of them; see `is_state`.
        reserved = {*BODY_KEYS, *PHYSICS_KEYS, *EXACT_KEYS}
        if any(isinstance(sensor, JointState) for sensor in sensors):
            reserved -= {"joint_position", "joint_velocity"}
        # The randomizer may observe a reserved key, so add its entries after the check
        # of `join_entries`.
        self.entries = join_entries(observers, reserved) | randomizer.entries
        observers.append(randomizer)
        self._observers = [observer for observer in observers if observer.entries]

    def after_reset(self, envs: Sequence[int]) -> None:
        """Tell the sensors that episodes have started in these environments."""
        for sensor in self._attached_sensors:
            sensor.after_reset(envs)

    def after_step(self, envs: Sequence[int]) -> None:
        """Tell the sensors that time has passed in these environments."""
        for sensor in self._attached_sensors:
            sensor.after_step(envs)

    def observe(
        self, goal: Tensor, step_count: Tensor, action: Tensor | None = None
    ) -> Observed:
        """Observe all environments.

        Args:
            goal: Desired goals, (n, goal_dim).
            step_count: Number of steps of the present episodes, (n, 1).
            action: The action that led to the present state, (n, action_dim); None
                after a reset.

        Returns:
            ``observation``, the goals, ``success``, ``terminated``, ``truncated``,
            ``done``, and the entries in `entries`; after a step also ``reward``, (n, 1)
            float32.

        Raises:
            ValueError: One of the first observations or rewards is NaN or infinite; a
                sensor returns other entries than it declares, or memory that it
                overwrites later; or the observation does not hold the achieved goal
                where `Task.goal_entries` declares it.
            TypeError: A sensor does not return tensors.
        """
        observed = self._observe_goals(goal)
        self._add_outcome(observed, step_count, action)
        for observer in self._observers:
            values = observer.observe()
            if self._num_to_check:
                self._check_entries(observer, values)
            observed |= values
        if self._num_to_check:
            self._check_numbers(observed)
            self._num_to_check -= 1
            if not self._num_to_check:
                self._last_values.clear()
        return observed

    def _observe_goals(self, goal: Tensor) -> Observed:
        """Compute observation and goals with torch, for goals (n, goal_dim)."""
        task, simulation = self._task, self._simulation
        observation = torch.cat(
            (self._robot.observation(simulation), task.observation(simulation)), dim=1
        )
        # A copy, because a task may return a tensor that the next step overwrites.
        achieved_goal = task.achieved_goal(simulation).to(torch.float32, copy=True)
        return {
            "observation": observation.float(),
            "achieved_goal": achieved_goal,
            "desired_goal": goal.float(),
        }

    def _add_outcome(
        self, observed: Observed, step_count: Tensor, action: Tensor | None
    ) -> None:
        """Compute the outcome: success and end flags, and after a step the reward."""
        task, simulation = self._task, self._simulation
        goals = observed["achieved_goal"], observed["desired_goal"]
        success = task.is_success(*goals)
        terminated = (
            success if self._terminate_on_success else torch.zeros_like(success)
        )
        if self._has_failure:
            terminated = terminated | task.failure(simulation)
        if self._may_terminate:  # no episode ends before its first step
            terminated = terminated & (step_count > 0)
        truncated = step_count >= self._max_episode_steps
        observed |= {
            "success": success,
            "terminated": terminated,
            "truncated": truncated,
            "done": terminated | truncated,
        }
        if action is not None and self._has_reward:
            reward = task.reward(simulation, action.clone(), *goals)
            observed["reward"] = reward.to(torch.float32, copy=True)
        elif action is not None:
            observed["reward"] = task.compute_reward(*goals).float()

    def _check_entries(self, observer: Observer, values: Observed) -> None:
        """Check the tensors that an observer returned; see `observe`."""
        function = f"{type(observer).__name__}.observe"
        if values.keys() != observer.entries.keys():
            raise ValueError(
                f"{function} must return the entries {sorted(observer.entries)}, "
                f"got {sorted(values)}"
            )
        n, state = self._simulation.num_envs, self._simulation.state.rows
        for key, (shape, dtype, _) in observer.entries.items():
            value = values[key]
            check_output(f"{function}()[{key!r}]", value, (n, *shape), dtype)
            memory = value.untyped_storage().data_ptr()
            others = (state, self._last_values.get(key, state))
            if value.numel() and any(
                memory == other.untyped_storage().data_ptr() for other in others
            ):
                raise ValueError(
                    f"{function} must return new tensors, but the next step overwrites "
                    f"the memory of {key!r}: return a copy, such as tensor.clone()"
                )
            self._last_values[key] = value

    def _check_numbers(self, observed: Observed) -> None:
        """Check the numbers that robot and task returned; see `observe`."""
        robot, task = type(self._robot).__name__, type(self._task).__name__
        num_robot = self._robot.observation_dim
        observation = observed["observation"]
        functions = {
            f"{robot}.observation": observation[:, :num_robot],
            f"{task}.observation": observation[:, num_robot:],
            f"{task}.achieved_goal": observed["achieved_goal"],
        }
        if "reward" in observed:
            name = "reward" if self._has_reward else "compute_reward"
            functions[f"{task}.{name}"] = observed["reward"]
        for function, values in functions.items():
            self._check_valid(function, values, values.isfinite(), "finite numbers")
        # Extra entries may be infinite, for example a distance to something unseen.
        for key, name in self._hook_keys.items():
            values = observed[key]
            self._check_valid(f"{name}[{key!r}]", values, ~values.isnan(), "no NaN")
        if self._goal_indices is not None:
            numbers = observation[:, self._goal_indices]
            achieved_goal = observed["achieved_goal"]
            if not torch.allclose(numbers, achieved_goal, equal_nan=True):
                raise ValueError(
                    f"the columns {self._goal_indices} of the observation must be the "
                    f"achieved goal, as {task}.goal_entries says, but they differ: "
                    f"{numbers.tolist()} and {achieved_goal.tolist()}"
                )

    def _check_valid(
        self, function: str, values: Tensor, is_valid: Tensor, requirement: str
    ) -> None:
        """Check the numbers, (n, ...), that a function of robot or task returned."""
        if is_valid.all():
            return
        invalid = (~is_valid).flatten(1).any(dim=1).nonzero().flatten().tolist()
        # In environments in which Bullet diverged, the function is not the cause.
        faulty = set(invalid).difference(self._simulation.diverged())
        if faulty:
            env = min(faulty)
            raise ValueError(
                f"{function} must return {requirement}, but returned "
                f"{values[env].tolist()} for environment {env}: look for a division by "
                f"0 or a root of a negative number"
            )

    def _check_functions(self) -> None:
        """Check that robot and task return the shapes that they declare."""
        robot, task, simulation = self._robot, self._task, self._simulation
        n, state = simulation.num_envs, simulation.state.rows
        goal = torch.zeros(n, task.goal_dim, dtype=torch.float64, device="cpu")
        for owner, name, size in (
            (robot, "observation", robot.observation_dim),
            (task, "observation", task.observation_dim),
            (task, "achieved_goal", task.goal_dim),
        ):
            function = f"{type(owner).__name__}.{name}"
            with _read_only(function, state):
                value = getattr(owner, name)(simulation)
            check_output(function, value, (n, size))
        task_name = type(task).__name__
        if simulation.scene.markers:
            shape = (n, len(simulation.scene.markers), 7)
            check_output(f"{task_name}.marker_pose", task.marker_pose(goal), shape)
        goals = task.achieved_goal(simulation).float(), goal.float()
        with _read_only(f"{task_name}.is_success", *goals):
            success = task.is_success(*goals)
        check_output(f"{task_name}.is_success", success, (n, 1), torch.bool)
        with _read_only(f"{task_name}.compute_reward", *goals):
            reward = task.compute_reward(*goals)
        check_output(f"{task_name}.compute_reward", reward, (n, 1))
        if self._has_reward:
            action = torch.zeros(n, robot.action_dim, dtype=torch.float32, device="cpu")
            with _read_only(f"{task_name}.reward", state, *goals):
                reward = task.reward(simulation, action, *goals)
            check_output(f"{task_name}.reward", reward, (n, 1))
        if self._has_failure:
            with _read_only(f"{task_name}.failure", state):
                failure = task.failure(simulation)
            check_output(f"{task_name}.failure", failure, (n, 1), torch.bool)
        if self._goal_indices is not None:
            size = robot.observation_dim + task.observation_dim
            is_inside = all(0 <= index < size for index in self._goal_indices)
            if len(self._goal_indices) != task.goal_dim or not is_inside:
                raise ValueError(
                    f"{task_name}.goal_entries must name {task.goal_dim} numbers of an "
                    f"observation, got {task.goal_entries}; the robot's part has "
                    f"{robot.observation_dim} numbers, and the task's part has "
                    f"{task.observation_dim}"
                )


class HookObserver:
    """Observes the entries of `Task.extra_observation` or `Task.info`.

    Args:
        task: The task.
        simulation: The environments.
        name: Name of the hook, one of `HOOKS`.

    Raises:
        ValueError: An entry does not have n rows.
        TypeError: The task does not return a dict of tensors.

    Attributes:
        entries: The entries, by key; empty if the task does not override the hook.
        function: Name of the task's function, for errors.
    """

    def __init__(self, task: Task, simulation: VectorSimulation, name: str) -> None:
        self._hook: Hook = getattr(task, name)
        self._simulation = simulation
        self.function = f"{type(task).__name__}.{name}"
        self.entries: dict[str, Entry] = {}
        if getattr(type(task), name) is getattr(Task, name):
            return
        with _read_only(self.function, simulation.state.rows):
            observed = self._hook(simulation)
        if not isinstance(observed, dict):
            raise TypeError(
                f"{self.function} must return a dict of tensors, got {observed!r}"
            )
        for key, value in observed.items():
            shape = tuple(value.shape[1:]) if isinstance(value, Tensor) else ()
            rows = simulation.num_envs
            check_output(f"{self.function}[{key!r}]", value, (rows, *shape))
            self.entries[key] = Entry(shape, _float32_copy(value).dtype)

    def observe(self) -> Observed:
        """The entries of all environments, (n, ...), in new tensors.

        Raises:
            ValueError: The task returns other keys than it did at first.
        """
        observed = self._hook(self._simulation)
        if observed.keys() != self.entries.keys():
            raise ValueError(
                f"{self.function} must always return {sorted(self.entries)}, "
                f"got {sorted(observed)}"
            )
        return {key: _float32_copy(value) for key, value in observed.items()}


@contextmanager
def _read_only(function: str, *tensors: Tensor) -> Iterator[None]:
    """Check that a function of a robot or task does not change tensors in place.

    Raises:
        ValueError: A tensor has changed.
    """
    # Changes in place increment this counter, also changes of a view of the tensor.
    versions = [tensor._version for tensor in tensors]
    yield
    if [tensor._version for tensor in tensors] != versions:
        raise ValueError(
            f"{function} must not change goals or the state of the simulation in "
            f"place: change a copy, such as tensor.clone()"
        )


def _float32_copy(value: Tensor) -> Tensor:
    """A new tensor, with float64 converted to float32."""
    return value.float() if value.dtype == torch.float64 else value.clone()
