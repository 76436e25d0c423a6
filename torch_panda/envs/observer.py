"""Observes episodes: state, goals, sensors, reward, success, and how episodes end."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torch_panda.bullet import VectorSimulation
from torch_panda.envs.randomization import PHYSICS_KEYS, DomainRandomizer
from torch_panda.envs.state import BODY_KEYS, EXACT_KEYS
from torch_panda.envs.task_problems import find_problems
from torch_panda.rendering import VectorRenderer
from torch_panda.robots import Robot
from torch_panda.sensors import Entry, JointState, Observer, Sensor, join_entries
from torch_panda.tasks import Task

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
        ValueError: Functions of the robot or the task return wrong tensors or change
            goals or state (one line per problem), or two sensors observe the same
            entry.

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
        # A hook that the task does not override is never called.
        self._has_reward = type(task).reward is not Task.reward
        self._has_failure = type(task).failure is not Task.failure
        self._may_terminate = terminate_on_success or self._has_failure
        if problems := find_problems(robot, task, simulation, goal_indices):
            raise ValueError("\n".join(problems))
        # Sensors also follow resets and steps; the other observers only observe.
        self._attached_sensors = [
            sensor.attach(simulation, renderer, robot) for sensor in sensors
        ]
        hooks = [HookObserver(task, simulation, name) for name in HOOKS]
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
        """
        observed = self._observe_goals(goal)
        self._add_outcome(observed, step_count, action)
        for observer in self._observers:
            observed |= observer.observe()
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


class HookObserver:
    """Observes the entries of `Task.extra_observation` or `Task.info`.

    Args:
        task: The task.
        simulation: The environments.
        name: Name of the hook, one of `HOOKS`.

    Attributes:
        entries: The entries, by key; empty if the task does not override the hook.
    """

    def __init__(self, task: Task, simulation: VectorSimulation, name: str) -> None:
        self._hook: Hook = getattr(task, name)
        self._simulation = simulation
        self.entries: dict[str, Entry] = {}
        if getattr(type(task), name) is getattr(Task, name):
            return
        for key, value in self._hook(simulation).items():
            shape = tuple(value.shape[1:])
            self.entries[key] = Entry(shape, _float32_copy(value).dtype)

    def observe(self) -> Observed:
        """The entries of all environments, (n, ...), in new tensors."""
        observed = self._hook(self._simulation)
        return {key: _float32_copy(value) for key, value in observed.items()}


def _float32_copy(value: Tensor) -> Tensor:
    """A new tensor, with float64 converted to float32."""
    return value.float() if value.dtype == torch.float64 else value.clone()
