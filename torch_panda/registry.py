"""The environments by name."""

import difflib
from itertools import product
from typing import Any

import torch

from torch_panda.bullet import ControlType
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
from torch_panda.versions import (
    ROBOT_ARGUMENTS,
    TASK_ARGUMENTS,
    VERSIONS,
    arguments_of,
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

_ENVS = {
    f"Panda{task}{control}{reward}-{version}": (task, control, reward, version)
    for task, control, reward, version in product(_TASKS, _CONTROL, _REWARD, VERSIONS)
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

    ``-v1`` follows the paper (arXiv 2106.13687) with the physical constants of
    panda-gym 1.1.0, ``-v3`` equals panda-gym 3.0.7; see `torch_panda.versions`.

    Raises:
        ValueError: the id is unknown, or an argument is out of range.
    """
    task, control, reward, version = _parts(env_id)
    return RobotTaskEnv(
        robot=Panda(
            control_type=_CONTROL[control],
            block_gripper=task in _BLOCKED_GRIPPER,
            **arguments_of(ROBOT_ARGUMENTS[task], version),
        ),
        task=_TASKS[task](
            reward_type=_REWARD[reward],
            **arguments_of(TASK_ARGUMENTS[task], version),
        ),
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
