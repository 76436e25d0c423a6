"""One environment with the interface of `gymnasium.Env`."""

import sys
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from torch_panda.envs import RobotTaskEnv
from torch_panda.envs.episodes import Observed
from torch_panda.gymnasium_envs import arrays
from torch_panda.gymnasium_envs.arrays import GoalFunctions, Observation
from torch_panda.gymnasium_envs.rendering import (
    RENDER_MODES,
    check_render_mode,
    take_camera,
)
from torch_panda.gymnasium_envs.spec import SpecAttribute, read_json
from torch_panda.registry import make
from torch_panda.rendering import Camera


class GoalEnv(GoalFunctions, gymnasium.Env[Observation, NDArray[np.float32]]):
    """A goal environment: ``gymnasium.make("torch_panda/PandaPush-v1")``.

    An observation is a dictionary of ``observation``, ``achieved_goal`` and
    ``desired_goal``, float32, and of the entries of cameras and other sensors.
    ``info["is_success"]`` says whether the goal is reached. The other infos are those
    of `Task.info`.

    Args:
        env: An id, or a `RobotTaskEnv` of batch size []. An environment that is made
            from an id leaves truncation to the ``TimeLimit`` of ``gymnasium.make``.
        render_mode: "rgb_array" or None.
        render_camera: Camera of `render`; None means panda-gym's view in 720 x 480
            pixels. This and the arguments ``camera``, ``physics`` and ``randomize`` may
            also be mappings of the fields, as they are in an ``EnvSpec`` from JSON.
        **arguments: panda-gym's arguments of the camera: ``render_width``,
            ``render_height``, ``render_target_position``, ``render_distance``,
            ``render_yaw``, ``render_pitch`` and ``render_roll``. If ``env`` is an id,
            also arguments of `torch_panda.make`.

    Raises:
        ValueError: The `RobotTaskEnv` is batched, or the render mode is unknown.
        TypeError: ``env`` is a `RobotTaskEnv`, but there are arguments of
            `torch_panda.make`.

    Attributes:
        torch_env: The `RobotTaskEnv` behind this environment.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (as declared by Gymnasium)
        "render_modes": list(RENDER_MODES),
        "render_fps": 25,
    }
    spec = SpecAttribute()

    def __init__(
        self,
        env: str | RobotTaskEnv,
        *,
        render_mode: str | None = None,
        render_camera: Camera | None = None,
        **arguments: Any,  # noqa: ANN401 (of torch_panda.make)
    ) -> None:
        check_render_mode(render_mode)
        arguments = read_json({"render_camera": render_camera, **arguments})
        self._camera = take_camera(arguments.pop("render_camera"), arguments)
        if isinstance(env, str):
            env = make(env, **{"max_episode_steps": sys.maxsize, **arguments})
        else:
            check_no_arguments(arguments)
        if env.batch_size:
            raise ValueError(
                f"the batch size must be [], got {list(env.batch_size)}: for several "
                "environments use gymnasium.make_vec or GoalVectorEnv"
            )
        self.torch_env = env
        self.metadata = metadata_of(env)
        self.render_mode = render_mode
        self.observation_space = arrays.observation_space(env)
        self.action_space = arrays.action_space(env)
        self._keys = arrays.observed_keys(env)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seed with which the sequence of episodes starts again, as with a new
                `RobotTaskEnv` of this seed; None continues the sequence.
            options: May hold ``state``, the state to start from, as
                `RobotTaskEnv.get_state` returns it, or some of its entries. The
                ``TimeLimit`` of ``gymnasium.make`` counts the steps since this reset,
                whatever the ``step_count`` of the state is.

        Raises:
            ValueError: An option is unknown, or the state is wrong.
            TypeError: The state is not a mapping of names to arrays of numbers.
            gymnasium.error.Error: The seed is negative.
        """
        state = arrays.read_state(options or {})
        super().reset(seed=seed)
        if seed is not None:
            self.torch_env.set_env_seed(0, seed)
        start = self.torch_env.episodes.reset(state=state)
        return self._observation(start), self._info(start)

    def step(
        self, action: ArrayLike
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Act for one step; see `RobotTaskEnv` for the errors."""
        after = self.torch_env.episodes.step(arrays.action(action))
        return (
            self._observation(after),
            float(after["reward"]),
            bool(after["terminated"]),
            bool(after["truncated"]),
            self._info(after),
        )

    def render(self) -> NDArray[np.uint8] | None:
        """A picture (height, width, 3) if the render mode is "rgb_array", else None."""
        if self.render_mode is None:
            return None
        return self.torch_env.render(camera=self._camera).cpu().numpy()

    def close(self) -> None:
        """Free the client. Closing again does nothing."""
        self.torch_env.close()

    def _observation(self, observed: Observed) -> Observation:
        return {key: observed[key][0].numpy() for key in self._keys}

    def _info(self, observed: Observed) -> dict[str, Any]:
        return arrays.info_of(arrays.infos(self.torch_env, observed), 0)


def metadata_of(env: RobotTaskEnv) -> dict[str, Any]:
    """Gymnasium's metadata, with one frame per step."""
    return {**GoalEnv.metadata, "render_fps": env.render_fps}


def check_no_arguments(arguments: dict[str, Any]) -> None:
    """Refuse arguments of `torch_panda.make` that come with a `RobotTaskEnv`.

    Raises:
        TypeError: There is at least one argument.
    """
    if arguments:
        raise TypeError(
            f"{sorted(arguments)} are accepted with an id only: pass them to the "
            f"RobotTaskEnv instead"
        )
