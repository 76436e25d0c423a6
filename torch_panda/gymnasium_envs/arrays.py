"""Between the tensors of an environment and the arrays of Gymnasium."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray
from tensordict import TensorDictBase
from torch import Tensor

from torch_panda.envs import RobotTaskEnv

Observation = dict[str, NDArray[Any]]

# What Gymnasium gives beside the observation, or in the infos.
_OUTCOME = {"success", "reward", "terminated", "truncated", "done"}


def observation_space(env: RobotTaskEnv) -> spaces.Space[Any]:
    """The space of what one environment observes, and of its goals.

    float32 without bounds, integers and booleans with those of their type.
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
    """The space of one environment's action, float32 in [-1, 1]."""
    return spaces.Box(-1.0, 1.0, (env.robot.action_dim,))


def observed_keys(env: RobotTaskEnv) -> list[str]:
    """What is observed, and the goals, in the order of Gymnasium's spaces."""
    return sorted(set(env.observation_spec.keys()) - _OUTCOME)


def action(values: ArrayLike) -> Tensor:
    """An action of any real type; the environment checks the rest."""
    return torch.from_numpy(np.asarray(values).astype(np.float64))


def read_state(options: Mapping[str, Any]) -> dict[str, Tensor] | None:
    """The state to start from that the options of a reset give; None: they give none.

    Raises:
        ValueError: there are other options, or the state has no entries.
        TypeError: the state is no mapping of names to arrays of numbers.
    """
    if unknown := set(options) - {"state"}:
        raise ValueError(f"accepted options are state, got {sorted(map(str, unknown))}")
    if "state" not in options:
        return None
    given = options["state"]
    if not isinstance(given, Mapping | TensorDictBase):
        raise TypeError(f"the state must be a mapping to arrays, got {given!r}")
    if not given.keys():
        raise ValueError("the state must have entries, got none")
    return {
        key: torch.from_numpy(np.asarray(value).copy()) for key, value in given.items()
    }


class GoalFunctions:
    """The pure functions of goals that hindsight relabelling calls."""

    torch_env: RobotTaskEnv

    def compute_reward(
        self,
        achieved_goal: ArrayLike,
        desired_goal: ArrayLike,
        info: Any = None,  # noqa: ANN401 (unused, as in Gymnasium-Robotics)
    ) -> NDArray[np.float32]:
        """The reward for an achieved goal.

        Args:
            achieved_goal: (..., goal_dim).
            desired_goal: (..., goal_dim).
            info: ignored.

        Returns:
            (...), float32.

        Raises:
            ValueError: a last dimension is not ``goal_dim``.
        """
        goals = _tensor(achieved_goal), _tensor(desired_goal)
        return _array(self.torch_env.compute_reward(*goals))

    def compute_terminated(
        self,
        achieved_goal: ArrayLike,
        desired_goal: ArrayLike,
        info: Any = None,  # noqa: ANN401
    ) -> NDArray[np.bool_]:
        """Whether an achieved goal ends the episode, (...); see `compute_reward`."""
        goals = _tensor(achieved_goal), _tensor(desired_goal)
        success = self.torch_env.is_success(*goals)
        return _array(success & self.torch_env.terminate_on_success)

    def compute_truncated(
        self,
        achieved_goal: ArrayLike,
        desired_goal: ArrayLike,
        info: Any = None,  # noqa: ANN401
    ) -> NDArray[np.bool_]:
        """False, (...): goals do not end an episode before its time."""
        goals = _tensor(achieved_goal), _tensor(desired_goal)
        return _array(torch.zeros_like(self.torch_env.is_success(*goals)))


def _tensor(goal: ArrayLike) -> Tensor:
    return torch.from_numpy(np.asarray(goal).astype(np.float32))


def _array(values: Tensor) -> NDArray[Any]:
    """(..., 1) to an array (...); to a numpy scalar where that is ()."""
    return values.squeeze(-1).numpy()[()]
