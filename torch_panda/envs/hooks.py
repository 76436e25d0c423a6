"""The hooks of a task that it overrides; the others cost nothing."""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from torch_panda.bullet import VectorSimulation
from torch_panda.envs.checks import check_result
from torch_panda.sensors import Entry
from torch_panda.tasks import Task

# (action, achieved_goal, desired_goal), (n, ...) each, to (n, 1).
StepReward = Callable[[Tensor, Tensor, Tensor], Tensor]


class TaskHooks:
    """What a task has overridden.

    Args:
        task: the task.
        simulation: the environments.
        action_dim: number of action entries.

    Raises:
        ValueError: a hook returns a wrong shape or dtype.
        TypeError: it returns something else.

    Attributes:
        reward: of the present state; None: the task's reward is of goals only.
        failure: where the episode has failed now, (n, 1) bool; None: never.
        entries: what `extra_observation` gives of one environment, by key.
        randomizes: whether there is a `Task.randomize`.
    """

    def __init__(
        self, task: Task, simulation: VectorSimulation, action_dim: int
    ) -> None:
        self._task = task
        self._simulation = simulation
        n = simulation.num_envs
        self.randomizes = _overrides(task, "randomize")
        self.reward: StepReward | None = None
        self.failure: Callable[[], Tensor] | None = None
        self.entries: dict[str, Entry] = {}
        if _overrides(task, "reward"):
            self.reward = partial(task.reward, simulation)
            goal = torch.zeros(n, task.goal_dim, dtype=torch.float32, device="cpu")
            action = torch.zeros(n, action_dim, dtype=torch.float32, device="cpu")
            reward = self.reward(action, goal, goal.clone())
            check_result(task, "reward", reward, (n, 1))
        if _overrides(task, "failure"):
            self.failure = partial(task.failure, simulation)
            check_result(task, "failure", self.failure(), (n, 1), torch.bool)
        if _overrides(task, "extra_observation"):
            found = task.extra_observation(simulation)
            if not isinstance(found, dict):
                raise TypeError(
                    f"{type(task).__name__}.extra_observation must return a dict of "
                    f"tensors, got {found!r}"
                )
            for key, value in found.items():
                rest = tuple(value.shape[1:]) if isinstance(value, Tensor) else ()
                check_result(task, f"extra_observation[{key!r}]", value, (n, *rest))
                self.entries[key] = Entry(rest, _observed(value).dtype)

    def observe(self) -> dict[str, Tensor]:
        """What `extra_observation` gives now, in new tensors."""
        if not self.entries:
            return {}
        found = self._task.extra_observation(self._simulation)
        if found.keys() != self.entries.keys():
            raise ValueError(
                f"{type(self._task).__name__}.extra_observation must always return "
                f"{sorted(self.entries)}, got {sorted(found)}"
            )
        return {key: _observed(value) for key, value in found.items()}


def _overrides(task: Task, name: str) -> bool:
    return getattr(type(task), name) is not getattr(Task, name)


def _observed(value: Tensor) -> Tensor:
    """A new tensor: float64 as float32."""
    return value.float() if value.dtype == torch.float64 else value.clone()
