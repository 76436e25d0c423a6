"""What is observed of episodes: state, goals, sensors, success and how they end."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_panda.bullet import VectorSimulation
from torch_panda.envs.hooks import TaskHooks
from torch_panda.envs.state import EXACT_KEYS, PHYSICAL
from torch_panda.envs.variation import PHYSICS, Variation
from torch_panda.rendering import VectorRenderer
from torch_panda.robots import Robot
from torch_panda.sensors import Observer, Sensor, join_entries
from torch_panda.tasks import Task

Observed = dict[str, Tensor]  # by entry, (n, ...), in new tensors


class EpisodeObserver:
    """Reads n environments of one robot and one task.

    Args:
        robot: the robot.
        task: the task, with its hooks.
        simulation: the environments.
        renderer: draws them for cameras.
        sensors: what is observed beyond state and goals.
        hooks: what the task has overridden.
        variation: what varies from episode to episode, and may be observed.
        max_episode_steps: steps until ``truncated``.
        terminate_on_success: whether success ends an episode.

    Raises:
        ValueError: two observe the same entry, or one an entry of the state.

    Attributes:
        entries: what is observed beyond state and goals, by key.
    """

    def __init__(
        self,
        robot: Robot,
        task: Task,
        simulation: VectorSimulation,
        renderer: VectorRenderer,
        *,
        sensors: Sequence[Sensor],
        hooks: TaskHooks,
        variation: Variation,
        max_episode_steps: int,
        terminate_on_success: bool,
    ) -> None:
        self._robot, self._task, self._simulation = robot, task, simulation
        self._hooks = hooks
        self._max_episode_steps = max_episode_steps
        self._terminate_on_success = terminate_on_success
        self._readings = [
            sensor.attach(simulation, renderer, robot) for sensor in sensors
        ]
        observers: list[Observer] = [*self._readings, hooks]
        reserved = (*PHYSICAL, *PHYSICS, *EXACT_KEYS)
        self.entries = join_entries(observers, reserved) | variation.entries
        self._observers = [each for each in (*observers, variation) if each.entries]

    def after_reset(self, envs: Sequence[int]) -> None:
        """Tell the sensors that episodes have started in these environments."""
        for reading in self._readings:
            reading.after_reset(envs)

    def after_step(self, envs: Sequence[int]) -> None:
        """Tell the sensors that time has passed in these environments."""
        for reading in self._readings:
            reading.after_step(envs)

    def observe(
        self, goal: Tensor, step_count: Tensor, action: Tensor | None = None
    ) -> Observed:
        """Observation, goals, success and ends, (n, ...), in new tensors.

        Args:
            goal: the desired goals, (n, goal_dim).
            step_count: steps of the present episodes, (n, 1).
            action: the one that led here, (n, action_dim): its ``reward``, (n, 1)
                float32, is observed, too.
        """
        simulation, task, failure = self._simulation, self._task, self._hooks.failure
        observation = torch.cat(
            (self._robot.observation(simulation), task.observation(simulation)), dim=1
        )
        # Copied in any case: a task may use its own tensor again.
        achieved_goal = task.achieved_goal(simulation).to(torch.float32, copy=True)
        desired_goal = goal.float()
        observed: Observed = {}
        success = task.is_success(achieved_goal, desired_goal)
        if action is not None:
            observed["reward"] = self._reward(action, achieved_goal, desired_goal)
        truncated = step_count >= self._max_episode_steps
        if self._terminate_on_success:
            terminated = success.logical_and(step_count)  # not before the first step
        else:
            terminated = torch.zeros_like(success)
        if failure is not None:
            terminated = terminated | failure() & (step_count > 0)
        for observer in self._observers:
            observed |= observer.observe()
        return {
            **observed,
            "observation": observation.float(),
            "achieved_goal": achieved_goal,
            "desired_goal": desired_goal,
            "success": success,
            "terminated": terminated,
            "truncated": truncated,
            "done": terminated.logical_or(truncated),
        }

    def _reward(
        self, action: Tensor, achieved_goal: Tensor, desired_goal: Tensor
    ) -> Tensor:
        """Reward of a step from the state after it, (n, 1) float32."""
        if self._hooks.reward is None:
            return self._task.compute_reward(achieved_goal, desired_goal).float()
        reward = self._hooks.reward(action.clone(), achieved_goal, desired_goal)
        return reward.to(torch.float32, copy=True)

    def watch(self, goal: Tensor, step_count: Tensor) -> Observed:
        """What a viewer says of the environments as they are, (n, ...)."""
        achieved_goal = self._task.achieved_goal(self._simulation).float()
        desired_goal = goal.float()
        return {
            "step_count": step_count,
            "achieved_goal": achieved_goal,
            "desired_goal": desired_goal,
            "success": self._task.is_success(achieved_goal, desired_goal),
        }
