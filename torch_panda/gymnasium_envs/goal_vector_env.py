"""Many environments with the interface of `gymnasium.vector.VectorEnv`."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from torch_panda.envs import RobotTaskEnv
from torch_panda.envs.episodes import Observed
from torch_panda.gymnasium_envs import arrays
from torch_panda.gymnasium_envs.arrays import GoalFunctions, Observation
from torch_panda.gymnasium_envs.goal_env import check_no_arguments, metadata_of
from torch_panda.gymnasium_envs.rendering import check_render_mode, take_camera
from torch_panda.gymnasium_envs.spec import SpecAttribute, read_json
from torch_panda.registry import make
from torch_panda.rendering import Camera


class GoalVectorEnv(
    GoalFunctions,
    VectorEnv[Observation, NDArray[np.float32], NDArray[Any]],
):
    """Goal environments stepped in parallel, in one process.

    ``gymnasium.make_vec("torch_panda/PandaPush-v1", num_envs=16)`` makes one. It
    returns the same values as a ``SyncVectorEnv`` of `GoalEnv`, in all autoreset modes.
    Environment i therefore gets the seed ``seed + i``.

    Args:
        env: An id, or a `RobotTaskEnv` of batch size [num_envs].
        num_envs: Number of environments, for an id; None means 1.
        autoreset_mode: When an environment is reset after its episode ended.
            NEXT_STEP: the next call of `step` resets it, and ignores its action.
            SAME_STEP: the step that ends the episode also resets it. The infos then
            hold ``final_obs`` and ``final_info``. DISABLED: the caller resets it with
            ``reset(options={"reset_mask": ...})``, and torchrl's `GymWrapper` needs
            this mode.
        render_mode: "rgb_array" or None.
        render_camera: Camera of `render`, as for `GoalEnv`.
        **arguments: Further arguments of `GoalEnv`.

    Raises:
        ValueError: The `RobotTaskEnv` is not batched, or a mode is unknown.
        TypeError: ``env`` is a `RobotTaskEnv`, but there are arguments of
            `torch_panda.make`.

    Attributes:
        torch_env: The `RobotTaskEnv` behind these environments.
        autoreset_mode: When environments are reset.
    """

    spec = SpecAttribute()

    def __init__(
        self,
        env: str | RobotTaskEnv,
        *,
        num_envs: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        render_camera: Camera | None = None,
        **arguments: Any,  # noqa: ANN401 (of GoalEnv)
    ) -> None:
        self.closed = True  # nothing needs closing until everything is built
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        check_render_mode(render_mode)
        arguments = read_json({"render_camera": render_camera, **arguments})
        self._camera = take_camera(arguments.pop("render_camera"), arguments)
        if isinstance(env, str):
            env = make(env, num_envs=1 if num_envs is None else num_envs, **arguments)
        else:
            number = {} if num_envs is None else {"num_envs": num_envs}
            check_no_arguments({**arguments, **number})
        if env.num_envs is None:
            raise ValueError("the batch size must be [num_envs], got []")
        self.torch_env = env
        self.num_envs = env.num_envs
        self.render_mode = render_mode
        self.metadata = {**metadata_of(env), "autoreset_mode": self.autoreset_mode}
        self.single_observation_space = arrays.observation_space(env)
        self.single_action_space = arrays.action_space(env)
        self._keys = arrays.observed_keys(env)
        self.observation_space = batch_space(
            self.single_observation_space, self.num_envs
        )
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._all = torch.ones(self.num_envs, dtype=torch.bool, device="cpu")
        # Environments that need a reset, (num_envs,).
        self._ended = self._all
        self._was_reset = False
        self.closed = False

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Observation, dict[str, Any]]:
        """Start episodes.

        Args:
            seed: A number gives environment i the seed ``seed + i``. A sequence holds
                one seed per environment. None continues the sequences of episodes.
            options: May hold ``reset_mask``, the environments to reset, (num_envs,)
                bool; and ``state``, the state to start from, as
                `RobotTaskEnv.get_state` returns it.

        Raises:
            ValueError: An option is unknown or has a wrong shape, or the number of
                seeds is wrong.
            TypeError: An option or a seed has a wrong type.
            gymnasium.error.Error: The seed is negative.
        """
        other_options = dict(options or {})
        mask = self._read_mask(other_options.pop("reset_mask", None))
        state = arrays.read_state(other_options)
        seeds = self._read_seeds(seed)
        super().reset(seed=seed if isinstance(seed, int) else None)
        for index in _indices(mask):
            own_seed = seeds[index]
            if own_seed is not None:
                self.torch_env.set_env_seed(index, own_seed)
        start = self.torch_env.episodes.reset(_indices(mask), state)
        # The first reset starts all environments.
        self._ended = self._ended & ~mask & self._was_reset
        self._was_reset = True
        return self._observation(start), self._infos(start, mask)

    def step(
        self, actions: ArrayLike
    ) -> tuple[
        Observation,
        NDArray[np.float64],
        NDArray[np.bool_],
        NDArray[np.bool_],
        dict[str, Any],
    ]:
        """Act for one step; see `RobotTaskEnv` for further errors.

        Raises:
            ResetNeeded: `reset` was not called yet; or, in the mode DISABLED, an
                environment was not reset after its episode ended.
        """
        mode, ended = self.autoreset_mode, self._ended
        if not self._was_reset or (mode is AutoresetMode.DISABLED and ended.any()):
            raise ResetNeeded(
                f"reset environments {_indices(ended)} before they are stepped"
            )
        resets_now = mode is AutoresetMode.NEXT_STEP and bool(ended.any())
        episodes = self.torch_env.episodes
        step_mask = ~ended.unsqueeze(1) if resets_now else None
        after = episodes.step(arrays.action(actions), step_mask)
        if resets_now:
            # An episode that diverged in this step keeps its last observation.
            for key, values in episodes.reset(_indices(ended)).items():
                after[key] = after[key].index_put((ended,), values[ended])
        outcome = (
            after["reward"].squeeze(1).double().numpy(),
            after["terminated"].squeeze(1).numpy(),
            after["truncated"].squeeze(1).numpy(),
        )
        self._ended = after["done"].squeeze(1)
        infos: dict[str, Any] = {}
        if mode is AutoresetMode.SAME_STEP and self._ended.any():
            infos = self._final_infos(after, self._ended)
            after = episodes.reset(_indices(self._ended))
            self._ended = torch.zeros_like(self._ended)
        infos |= self._infos(after, self._all)
        return self._observation(after), *outcome, infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Pictures (height, width, 3) if the render mode is "rgb_array", else None."""
        if self.render_mode is None:
            return None
        return tuple(self.torch_env.render(camera=self._camera).cpu().numpy())

    def close_extras(self, **kwargs: Any) -> None:  # noqa: ANN401 (Gymnasium's)
        """Free all clients and threads."""
        self.torch_env.close()

    def _observation(self, observed: Observed) -> Observation:
        return {key: observed[key].numpy() for key in self._keys}

    def _infos(self, after: Observed, mask: Tensor) -> dict[str, Any]:
        infos: dict[str, Any] = {}
        for key, values in arrays.infos(self.torch_env, after).items():
            # As in Gymnasium, environments without this info have zeros.
            infos[key] = np.where(_like(mask, values), values, np.zeros_like(values))
            infos[f"_{key}"] = mask.clone().numpy()
        return infos

    def _final_infos(self, after: Observed, mask: Tensor) -> dict[str, Any]:
        infos: dict[str, Any] = {}
        own_infos = arrays.infos(self.torch_env, after)
        for index in _indices(mask):
            last = {key: values[index] for key, values in after.items()}
            final = {
                "final_obs": self._observation(last),
                "final_info": arrays.info_of(own_infos, index),
            }
            infos = self._add_info(infos, final, index)
        return infos

    def _read_mask(self, mask: NDArray[np.bool_] | None) -> Tensor:
        """The environments to reset, (num_envs,) bool."""
        if mask is None:
            return self._all
        shape = (self.num_envs,)
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
            raise TypeError(f"reset_mask must be an array of bool, got {mask!r}")
        if mask.shape != shape or not mask.any():
            raise ValueError(
                f"reset_mask must have shape {shape} and be True for at least one "
                f"environment, got {mask!r}"
            )
        return torch.from_numpy(mask.copy())

    def _read_seeds(
        self, seed: int | Sequence[int | None] | None
    ) -> Sequence[int | None]:
        """One seed or None per environment."""
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, int | np.integer):
            return [int(seed) + index for index in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ValueError(
                f"seed must be a number or a sequence of {self.num_envs} seeds, got "
                f"{len(seed)} seeds"
            )
        return seed


def _like(mask: Tensor, values: NDArray[Any]) -> NDArray[np.bool_]:
    """A mask (n,) in a shape that broadcasts to values (n, ...)."""
    return mask.numpy().reshape(-1, *(1,) * (values.ndim - 1))


def _indices(mask: Tensor) -> list[int]:
    return mask.nonzero().flatten().tolist()
