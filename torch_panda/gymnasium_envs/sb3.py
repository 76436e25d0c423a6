"""Many environments with the interface of Stable-Baselines3's ``VecEnv``.

Importing this module needs ``stable-baselines3``.
"""

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import (
    VecEnvIndices,
    VecEnvStepReturn,
)

from torch_panda.envs import RobotTaskEnv
from torch_panda.gymnasium_envs.arrays import Observation, info_of
from torch_panda.gymnasium_envs.goal_vector_env import GoalVectorEnv
from torch_panda.gymnasium_envs.panda_gym import PandaGymErrors


class SB3VecEnv(PandaGymErrors, VecEnv):
    """A `GoalVectorEnv` for Stable-Baselines3.

    All environments share one object, ``vector_env``. `get_attr` and `env_method`
    therefore read its attributes and call its methods once, and repeat the result for
    each index.

    Args:
        env: An id, or a `RobotTaskEnv` of batch size [num_envs].
        **arguments: Arguments of `GoalVectorEnv` except ``autoreset_mode``.

    Attributes:
        vector_env: The `GoalVectorEnv`.
        torch_env: The `RobotTaskEnv` behind it.
    """

    def __init__(
        self,
        env: str | RobotTaskEnv,
        **arguments: Any,  # noqa: ANN401 (of GoalVectorEnv)
    ) -> None:
        self.vector_env = GoalVectorEnv(
            env, autoreset_mode=AutoresetMode.SAME_STEP, **arguments
        )
        self.torch_env = self.vector_env.torch_env
        super().__init__(
            self.vector_env.num_envs,
            self.vector_env.single_observation_space,
            self.vector_env.single_action_space,
        )
        self.metadata = self.vector_env.metadata

    def reset(self) -> Observation:
        """Start an episode in each environment, with the seeds of the last `seed`."""
        observation, infos = self.vector_env.reset(seed=self._seeds)
        own_infos = self._own_infos(infos)
        self.reset_infos = [info_of(own_infos, i) for i in range(self.num_envs)]
        self._reset_seeds()
        return observation

    def set_options(
        self, options: list[dict[str, Any]] | dict[str, Any] | None = None
    ) -> None:
        """Refuse options of the next reset.

        Raises:
            ValueError: There are options.
        """
        if options and any(options):
            raise ValueError(
                "set_options is not supported: call vector_env.reset(options=...)"
            )

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Store the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Take the step and reset the environments whose episode ended."""
        observation, rewards, terminated, truncated, infos = self.vector_env.step(
            self._actions
        )
        done = terminated | truncated
        own_infos = self._own_infos(infos)
        list_of_infos: list[dict[str, Any]] = [
            {**info_of(own_infos, index), "TimeLimit.truncated": bool(is_truncated)}
            for index, is_truncated in enumerate(truncated & ~terminated)
        ]
        # If an episode ended, report the infos of its last step. `own_infos` holds the
        # infos of the next episode's start.
        for index in done.nonzero()[0].tolist():
            self.reset_infos[index] = info_of(own_infos, index)
            list_of_infos[index] |= info_of(self._own_infos(infos["final_info"]), index)
            list_of_infos[index]["terminal_observation"] = infos["final_obs"][index]
        return observation, rewards.astype(np.float32), done, list_of_infos

    def _own_infos(self, infos: dict[str, Any]) -> dict[str, Any]:
        """Infos that the environments return in every step, (num_envs, ...) by key."""
        keys = ("is_success", *self.torch_env.episodes.info_keys)
        return {key: infos[key] for key in keys}

    def close(self) -> None:
        """Free all clients and threads."""
        self.vector_env.close()

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """One picture per environment."""
        return self.vector_env.render() or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of the `GoalVectorEnv`, once per index."""
        return [getattr(self.vector_env, attr_name)] * self._count(indices)

    def set_attr(
        self,
        attr_name: str,
        value: Any,  # noqa: ANN401 (Stable-Baselines3's signature)
        indices: VecEnvIndices = None,
    ) -> None:
        """Set an attribute of the `GoalVectorEnv`, for all environments.

        Raises:
            ValueError: ``indices`` does not name all environments.
        """
        if self._count(indices) != self.num_envs:
            raise ValueError("attributes can only be set for all environments at once")
        setattr(self.vector_env, attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,  # noqa: ANN401
        indices: VecEnvIndices = None,
        **method_kwargs: Any,  # noqa: ANN401
    ) -> list[Any]:
        """Call a method of the `GoalVectorEnv`; repeat the result once per index."""
        method: Callable[..., Any] = getattr(self.vector_env, method_name)
        return [method(*method_args, **method_kwargs)] * self._count(indices)

    def env_is_wrapped(
        self,
        wrapper_class: type[gymnasium.Wrapper],
        indices: VecEnvIndices = None,
    ) -> list[bool]:
        """Always false, because single environments cannot have wrappers."""
        return [False] * self._count(indices)

    def _count(self, indices: VecEnvIndices) -> int:
        return len(list(self._get_indices(indices)))
