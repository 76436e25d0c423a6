"""The environments by name."""

import difflib
from collections.abc import Sequence
from itertools import product
from typing import Any

import gymnasium
import torch

from torch_panda.envs import RobotTaskEnv
from torch_panda.rendering import Camera
from torch_panda.robots import ControlType, Panda
from torch_panda.sensors import Sensor, read_keywords
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
    NO_PAIRS,
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
    from_pixels: bool = False,
    pixels_only: bool = False,
    depth: bool = False,
    segmentation: bool = False,
    camera: Camera | None = None,
    render_size: int | tuple[int, int] | None = None,
    sensors: Sequence[Sensor | str] = (),
    **options: Any,  # noqa: ANN401 (those of RobotTaskEnv)
) -> RobotTaskEnv:
    """Make the environments of an id.

    ``-v1`` follows the paper (arXiv 2106.13687) with the physical constants of
    panda-gym 1.1.0, ``-v3`` equals panda-gym 3.0.7; see `torch_panda.versions`.

    Args:
        env_id: one of `ENV_IDS`.
        num_envs: see `RobotTaskEnv`, also for the next three.
        num_threads: threads that step them.
        seed: of all random draws.
        device: where the outputs are placed.
        from_pixels: observe ``pixels``, uint8 (*batch, height, width, 3).
        pixels_only: leave ``observation`` out; the goals stay.
        depth: observe ``depth``, float32 (*batch, height, width, 1) [m].
        segmentation: observe ``segmentation``, int32 (*batch, height, width, 1), the
            body ids of ``segmentation_ids``; see `CameraSensor`.
        camera: of what is observed; None means panda-gym's view in 64 x 64 pixels.
        render_size: height and width of what is observed [pixels], or both in one
            number; None means the camera's.
        sensors: "wrist_force_torque", "finger_contact" and "joint_torque", each
            observed under its own key, float32; or other sensors.
        **options: the other arguments of `RobotTaskEnv`.

    Raises:
        ValueError: the id is unknown, or an argument is out of range.
    """
    task, control, reward, version = _parts(env_id)
    if pixels_only and not from_pixels:
        raise ValueError("pixels_only=True needs from_pixels=True")
    return RobotTaskEnv(
        robot=Panda(
            control_type=_CONTROL[control],
            block_gripper=task in _BLOCKED_GRIPPER,
            **arguments_of(ROBOT_ARGUMENTS.get(task, NO_PAIRS), version),
        ),
        task=_TASKS[task](
            reward_type=_REWARD[reward],
            **arguments_of(TASK_ARGUMENTS.get(task, NO_PAIRS), version),
        ),
        num_envs=num_envs,
        num_threads=num_threads,
        seed=seed,
        device=device,
        sensors=read_keywords(
            from_pixels=from_pixels,
            depth=depth,
            segmentation=segmentation,
            camera=camera,
            render_size=render_size,
            sensors=sensors,
        ),
        observe_state=not pixels_only,
        **({"terminate_on_success": version == "v3"} | options),
    )


def max_episode_steps(env_id: str) -> int:
    """The number of steps after which an id's episodes are truncated.

    Raises:
        ValueError: the id is unknown.
    """
    return _TASKS[_parts(env_id)[0]].max_episode_steps


def register_with_gymnasium() -> None:
    """Register ``torch_panda/{id}`` for every id, for ``make`` and ``make_vec``.

    By name: the classes are imported when the first one is made. ``gymnasium.make``
    truncates with its own ``TimeLimit``, so that its argument ``max_episode_steps``
    works as for any other environment.
    """
    for env_id in ENV_IDS:
        gymnasium.register(
            f"torch_panda/{env_id}",
            entry_point="torch_panda.gymnasium_envs:GoalEnv",
            vector_entry_point="torch_panda.gymnasium_envs:GoalVectorEnv",
            max_episode_steps=max_episode_steps(env_id),
            kwargs={"env": env_id},
        )


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
