"""The environments by name."""

import difflib
from itertools import product
from typing import Any

import torch

from torch_panda.bullet import ControlType
from torch_panda.bullet.shapes import BLUE
from torch_panda.envs import RobotTaskEnv
from torch_panda.robots import Panda
from torch_panda.tasks import (
    Flip,
    PickAndPlace,
    Push,
    Reach,
    RewardType,
    Slide,
    Stack,
    Task,
)

_TASKS: dict[str, type[Task]] = {
    "Reach": Reach,
    "Push": Push,
    "Slide": Slide,
    "PickAndPlace": PickAndPlace,
    "Stack": Stack,
    "Flip": Flip,
}
# Tasks that are done with the gripper blocked, so without an action for it.
_BLOCKED_GRIPPER = ("Reach", "Push", "Slide")
_CONTROL: dict[str, ControlType] = {"": "ee", "Joints": "joints"}
_REWARD: dict[str, RewardType] = {"": "sparse", "Dense": "dense"}
# The tasks' defaults are the paper's (-v1); this is where panda-gym 3.0.7 differs.
_V3_ARGUMENTS: dict[str, dict[str, Any]] = {
    "Slide": {
        "goal_xy_range": 0.3,
        "goal_x_offset": 0.4,
        "table_length": 1.4,
        "table_x_offset": -0.1,
    },
    "Stack": {"distance_threshold": 0.1, "per_object": False, "lower_color": BLUE},
}
_VERSIONS = ("v1", "v3")

_ENVS = {
    f"Panda{task}{control}{reward}-{version}": (task, control, reward, version)
    for task, control, reward, version in product(_TASKS, _CONTROL, _REWARD, _VERSIONS)
}

ENV_IDS: tuple[str, ...] = tuple(_ENVS)
"""``Panda{task}{,Joints}{,Dense}-v{1,3}`` for the six tasks."""


def make(
    env_id: str,
    *,
    num_envs: int | None = None,
    num_threads: int | None = None,
    seed: int | None = None,
    device: torch.device | str | int | None = None,
    **options: Any,  # noqa: ANN401 (those of RobotTaskEnv)
) -> RobotTaskEnv:
    """Make the environments of an id; see `RobotTaskEnv` for arguments and options.

    ``-v1`` follows the paper (arXiv 2106.13687), ``-v3`` equals panda-gym 3.0.7.

    Raises:
        ValueError: the id is unknown, or an argument is out of range.
    """
    task, control, reward, version = _parts(env_id)
    arguments = _V3_ARGUMENTS.get(task, {}) if version == "v3" else {}
    return RobotTaskEnv(
        robot=Panda(
            control_type=_CONTROL[control], block_gripper=task in _BLOCKED_GRIPPER
        ),
        task=_TASKS[task](reward_type=_REWARD[reward], **arguments),
        num_envs=num_envs,
        num_threads=num_threads,
        seed=seed,
        device=device,
        **({"terminate_on_success": version == "v3"} | options),
    )


def max_episode_steps(env_id: str) -> int:
    """The number of steps after which an id's episodes are truncated.

    Raises:
        ValueError: the id is unknown.
    """
    return _TASKS[_parts(env_id)[0]].max_episode_steps


def _parts(env_id: str) -> tuple[str, str, str, str]:
    """Task, control, reward and version of an id."""
    if not isinstance(env_id, str) or env_id not in _ENVS:
        close = difflib.get_close_matches(str(env_id), ENV_IDS, n=3)
        hint = f"did you mean {' or '.join(close)}? " if close else ""
        raise ValueError(
            f"unknown environment id {env_id!r}; {hint}accepted are "
            f"Panda{{{','.join(_TASKS)}}}{{,Joints}}{{,Dense}}-v{{1,3}}"
        )
    return _ENVS[env_id]
