"""Converts between the tensors of an environment and the arrays of Gymnasium."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from torch_panda.checks import check_instance
from torch_panda.envs import RobotTaskEnv
from torch_panda.envs.episodes import Observed
from torch_panda.envs.state import EXACT_KEYS, PLAIN_KEYS
from torch_panda.gymnasium_envs.panda_gym import PandaGymErrors

Observation = dict[str, NDArray[Any]]

# Entries that Gymnasium returns outside the observation.
_OUTCOME = {"success", "reward", "terminated", "truncated", "done"}


def observation_space(env: RobotTaskEnv) -> spaces.Space[Any]:
    """Space of the observations and goals of one environment.

    float32 entries have no bounds. The bounds of integers and booleans are those of
    their type.
    """
    boxes: dict[str, spaces.Space[Any]] = {}
    for key in observed_keys(env):
        zero = env.observation_spec[key].zero().cpu().numpy()
        shape = zero.shape[env.batch_dims :]
        low, high = -np.inf, np.inf
        if zero.dtype.kind in "iu":
            low, high = np.iinfo(zero.dtype).min, np.iinfo(zero.dtype).max
        elif zero.dtype.kind == "b":
            low, high = 0, 1
        boxes[key] = spaces.Box(low, high, shape, zero.dtype.type)
    return spaces.Dict(boxes)


def action_space(env: RobotTaskEnv) -> spaces.Space[Any]:
    """Space of the action of one environment, float32 in [-1, 1]."""
    return spaces.Box(-1.0, 1.0, (env.robot.action_dim,))


def observed_keys(env: RobotTaskEnv) -> list[str]:
    """Keys of observations and goals, in the order of Gymnasium's spaces."""
    keys = set(env.observation_spec.keys())
    return sorted(keys - _OUTCOME - env.episodes.info_keys)


def action(values: ArrayLike) -> Tensor:
    """Convert an action of any real dtype; the environment checks its values."""
    return torch.from_numpy(np.asarray(values).astype(np.float64))


def read_state(options: Mapping[str, Any]) -> dict[str, Tensor] | None:
    """Read the state to start from in the options of a reset.

    Returns:
        The state as tensors; None if the options have no ``state``.

    Raises:
        ValueError: An option has another name, or the state has no entries or unknown
            ones.
        TypeError: The state is not a mapping, or a value is not an array of numbers.
    """
    if unknown := set(options) - {"state"}:
        raise ValueError(
            f"the only accepted option is 'state', got {sorted(map(str, unknown))}"
        )
    if "state" not in options:
        return None
    state = options["state"]
    check_instance("state", state, Mapping)
    if not state.keys():
        raise ValueError("the state must have entries, got none")
    unknown_keys = set(state.keys()).difference(PLAIN_KEYS, EXACT_KEYS)
    if unknown_keys:
        raise ValueError(
            f"the state has unknown entries {sorted(map(str, unknown_keys))}; accepted "
            f"are those of get_state(): {', '.join(PLAIN_KEYS)}"
        )
    return {
        key: value.cpu().clone()
        if isinstance(value, Tensor)
        else torch.from_numpy(np.array(value))
        for key, value in state.items()
    }


def infos(env: RobotTaskEnv, observed: Observed) -> dict[str, NDArray[Any]]:
    """Infos of all environments, (num_envs, ...) by key: success and `Task.info`."""
    entries = {key: observed[key].numpy() for key in sorted(env.episodes.info_keys)}
    return {"is_success": observed["success"].squeeze(1).numpy(), **entries}


def info_of(infos: Mapping[str, NDArray[Any]], index: int) -> dict[str, NDArray[Any]]:
    """The info of one environment.

    Its values are arrays, also those without dimensions, as in panda-gym: torchrl reads
    the dtype of infos, which a bool does not have, and Gymnasium's vector environments
    do not stack numpy scalars.
    """
    return {key: np.array(values[index]) for key, values in infos.items()}


class GoalFunctions(PandaGymErrors):
    """The pure functions of goals that Gymnasium-Robotics' goal environments have.

    Attributes:
        torch_env: The `RobotTaskEnv` whose reward and success they compute.
    """

    torch_env: RobotTaskEnv

    def compute_reward(
        self,
        achieved_goal: ArrayLike,
        desired_goal: ArrayLike,
        info: Any = None,  # noqa: ANN401 (unused, as in Gymnasium-Robotics)
    ) -> NDArray[np.float32]:
        """Rewards, (...) float32, for goals (..., goal_dim). ``info`` is ignored.

        Raises:
            ValueError: A last dimension is not ``goal_dim``.
        """
        goals = _tensor(achieved_goal), _tensor(desired_goal)
        return _array(self.torch_env.compute_reward(*goals))

    def compute_terminated(
        self,
        achieved_goal: ArrayLike,
        desired_goal: ArrayLike,
        info: Any = None,  # noqa: ANN401
    ) -> NDArray[np.bool_]:
        """Whether achieved goals end the episode, (...); see `compute_reward`."""
        goals = _tensor(achieved_goal), _tensor(desired_goal)
        success = self.torch_env.is_success(*goals)
        return _array(success & self.torch_env.terminate_on_success)

    def compute_truncated(
        self,
        achieved_goal: ArrayLike,
        desired_goal: ArrayLike,
        info: Any = None,  # noqa: ANN401
    ) -> NDArray[np.bool_]:
        """Always false, (...): only the length of an episode truncates it."""
        goals = _tensor(achieved_goal), _tensor(desired_goal)
        return _array(torch.zeros_like(self.torch_env.is_success(*goals)))


def _tensor(goal: ArrayLike) -> Tensor:
    return torch.from_numpy(np.asarray(goal).astype(np.float32))


def _array(values: Tensor) -> NDArray[Any]:
    """Convert (..., 1) to an array (...), or (1,) to a numpy scalar."""
    return values.squeeze(-1).numpy()[()]
