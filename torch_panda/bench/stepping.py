"""What is measured at once, and how its environments are stepped."""

import re
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from torch_panda.bench.processes import cpu_time
from torch_panda.bullet.body_state import Doubles
from torch_panda.envs import RobotTaskEnv


class Speed(NamedTuple):
    """Steps of all environments together, by two clocks.

    Attributes:
        per_second: steps per second.
        per_cpu_second: steps per second of processor time, of all processes; other
            work on the machine hardly changes it.
    """

    per_second: float
    per_cpu_second: float


@dataclass(frozen=True)
class Setting:
    """What is measured at once.

    Attributes:
        env_id: one of `torch_panda.ENV_IDS`.
        num_envs: number of environments.
        num_threads: threads of what runs in threads.
    """

    env_id: str
    num_envs: int
    num_threads: int

    @property
    def task(self) -> str:
        """The task's name, for instance "Push"."""
        match = re.fullmatch(r"Panda(.+?)(Joints)?(Dense)?-v\d", self.env_id)
        assert match is not None
        return match[1]

    @property
    def is_joints(self) -> bool:
        """Whether actions are of the joints."""
        return "Joints" in self.env_id


class Contender(ABC):
    """``num_envs`` environments that are stepped with random actions."""

    @abstractmethod
    def step(self) -> None:
        """Step all environments once, and reset those whose episode ended."""

    @abstractmethod
    def reset(self) -> None:
        """Reset all environments."""

    @abstractmethod
    def close(self) -> None:
        """Free all of it."""

    def measure(self, num_envs: int, steps: int) -> Speed:
        """Speed of all environments over some steps of each."""
        start, cpu_start = time.perf_counter(), cpu_time()
        for _ in range(steps):
            self.step()
        wall, cpu = time.perf_counter() - start, cpu_time() - cpu_start
        return Speed(num_envs * steps / wall, num_envs * steps / cpu)


class TorchRLContender(Contender):
    """A batched environment of torchrl."""

    def __init__(self, env: EnvBase) -> None:
        self._env = env
        self._action_shape = env.action_spec.shape
        self._td: TensorDictBase = env.reset()

    def step(self) -> None:
        """Step all environments once."""
        self._td["action"] = torch.rand(self._action_shape) * 2 - 1
        _, self._td = self._env.step_and_maybe_reset(self._td)

    def reset(self) -> None:
        """Reset all environments."""
        self._td = self._env.reset()

    def close(self) -> None:
        """Free all of it."""
        self._env.close()


class VectorEnvContender(Contender):
    """A vector environment of Gymnasium or Stable-Baselines3."""

    def __init__(self, env: Any, num_envs: int, action_dim: int) -> None:  # noqa: ANN401 (two libraries)
        self._env = env
        self._action_shape = (num_envs, action_dim)
        self._rng = np.random.default_rng(0)
        self.reset()

    def step(self) -> None:
        """Step all environments once."""
        action = self._rng.uniform(-1, 1, size=self._action_shape)
        self._env.step(action.astype(np.float32))

    def reset(self) -> None:
        """Reset all environments."""
        self._env.reset()

    def close(self) -> None:
        """Free all of it."""
        self._env.close()


class BareBulletContender(Contender):
    """The loop of torch_panda's environments, with nothing between its steps.

    It repeats an episode of random actions, whose setpoints are found the first time.
    """

    def __init__(self, env: RobotTaskEnv) -> None:
        self._env = env
        env.reset()
        self._simulation = simulation = env.episodes.simulation
        state = (
            simulation.joint_position,
            simulation.joint_velocity,
            simulation.object_pose,
            simulation.object_velocity,
            simulation.object_joint_position,
            simulation.object_joint_velocity,
        )
        self._start = [(tensor, tensor.clone()) for tensor in state]
        self._control = env.robot.motor_control
        self._setpoints: list[Doubles] = []
        self._num_steps = 0  # of this episode

    def step(self) -> None:
        """Step all clients once."""
        if self._num_steps == self._env.max_episode_steps:
            self.reset()
        if self._num_steps == len(self._setpoints):
            action = self._env.action_spec.rand()
            setpoint = self._env.robot.setpoint(action, self._simulation)
            self._setpoints.append(setpoint.numpy())
        self._simulation.step(self._control, self._setpoints[self._num_steps])
        self._num_steps += 1

    def reset(self) -> None:
        """Put all clients to the start."""
        for tensor, start in self._start:
            tensor.copy_(start)
        self._simulation.reset(range(self._simulation.num_envs))
        self._num_steps = 0

    def close(self) -> None:
        """Free all of it."""
        self._env.close()
