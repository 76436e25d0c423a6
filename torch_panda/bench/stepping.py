"""What is measured at once, and how its environments are stepped."""

import re
import tempfile
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from torch_panda.bench.bare_bullet import Speed, load_bare_bullet
from torch_panda.bench.processes import cpu_time


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
    """The Push scene, stepped by C threads that never wait for each other."""

    def __init__(self, setting: Setting) -> None:
        self._setting = setting
        self._directory = tempfile.TemporaryDirectory()
        self._run = load_bare_bullet(self._directory.name)

    def step(self) -> None:
        """Not available: all its steps run in C, see `measure`."""
        raise NotImplementedError

    def reset(self) -> None:
        """Not available: its resets run in C."""
        raise NotImplementedError

    def close(self) -> None:
        """Remove the compiled library."""
        self._directory.cleanup()

    def measure(self, num_envs: int, steps: int) -> Speed:
        """Build the environments, then time their steps."""
        return self._run(num_envs, self._setting.num_threads, steps)
