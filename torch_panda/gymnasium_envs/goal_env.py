"""One environment with Gymnasium's interface."""

import sys
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray
from tensordict import TensorDict

from torch_panda.envs import RobotTaskEnv
from torch_panda.gymnasium_envs import arrays
from torch_panda.gymnasium_envs.arrays import GoalFunctions, Observation
from torch_panda.registry import make


class GoalEnv(GoalFunctions, gymnasium.Env[Observation, NDArray[np.float32]]):
    """A goal environment: ``gymnasium.make("torch_panda/PandaPush-v1")``.

    Observations are dictionaries of ``observation``, ``achieved_goal`` and
    ``desired_goal``, float32, and of pixels or sensors if asked for;
    ``info["is_success"]`` says whether the goal is reached.

    Args:
        env: an id of `torch_panda.ENV_IDS`, whose episodes ``gymnasium.make``
            truncates, or an environment of batch size [].
        render_mode: "rgb_array" or None.
        **arguments: of `torch_panda.make`, for an id.

    Raises:
        ValueError: the environment is batched.

    Attributes:
        torch_env: the environment behind it.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (as declared by Gymnasium)
        "render_modes": ["rgb_array"],
        "render_fps": 25,
    }

    def __init__(
        self,
        env: str | RobotTaskEnv,
        *,
        render_mode: str | None = None,
        **arguments: Any,  # noqa: ANN401 (of torch_panda.make)
    ) -> None:
        if isinstance(env, str):
            env = make(env, max_episode_steps=sys.maxsize, **arguments)
        if env.batch_size:
            raise ValueError(f"the batch size must be [], got {list(env.batch_size)}")
        self.torch_env = env
        self.render_mode = render_mode
        self.observation_space = arrays.observation_space(env)
        self.action_space = arrays.action_space(env)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: restarts the sequence of episodes, as the seed of `RobotTaskEnv`.
            options: ``state``, as `RobotTaskEnv.get_state` returns it or a part of it,
                to start from.

        Raises:
            ValueError: an option is unknown, or the state is wrong.
            TypeError: the state is no mapping of names to arrays of numbers.
            gymnasium.error.Error: the seed is negative.
        """
        state = arrays.read_state(options or {}, self.torch_env)
        super().reset(seed=seed)
        if seed is not None:
            self.torch_env.set_env_seed(0, seed)
        start = self.torch_env._reset(state, set_state=not state.is_empty())
        return arrays.observation(start), {"is_success": start["success"].item()}

    def step(
        self, action: ArrayLike
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Act for one step; see `RobotTaskEnv` for what is raised."""
        # The method that torchrl's `step` calls, without its checks of specs.
        after = self.torch_env._step(TensorDict({"action": arrays.action(action)}))
        return (
            arrays.observation(after),
            after["reward"].item(),
            after["terminated"].item(),
            after["truncated"].item(),
            {"is_success": after["success"].item()},
        )

    def render(self) -> NDArray[np.uint8] | None:
        """An image (height, width, 3), if the render mode is "rgb_array"."""
        if self.render_mode is None:
            return None
        return np.asarray(self.torch_env.render())

    def close(self) -> None:
        """Free the client. Closing again does nothing."""
        self.torch_env.close()
