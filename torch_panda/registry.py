"""The environments by name."""

import difflib
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any

import gymnasium
import torch

from torch_panda.envs import RobotTaskEnv
from torch_panda.envs.checks import check_positive
from torch_panda.rendering import Camera
from torch_panda.robots import (
    ControlType,
    Kuka,
    Panda,
    Robot,
    XArm6,
    XArm6Gripper,
)
from torch_panda.sensors import Sensor, read_keywords
from torch_panda.tasks import (
    Drawer,
    Flip,
    PegInsertion,
    PickAndPlace,
    Push,
    Reach,
    RewardType,
    Slide,
    Stack,
    Task,
)
from torch_panda.tasks.peg_insertion import GRASP_WIDTH
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
    "Drawer": Drawer,
    "PegInsertion": PegInsertion,
}
# Tasks that are done with the gripper blocked, so without an action for it.
_BLOCKED_GRIPPER = ("Reach", "Push", "Slide", "Drawer", "PegInsertion")
# Those that panda-gym does not have, and what their robots are made with.
_OWN_TASKS: dict[str, dict[str, Any]] = {
    "Drawer": {},
    "PegInsertion": {"fingers_width": GRASP_WIDTH, "finger_friction": 5.0},
}
_CONTROL: dict[str, ControlType] = {"": "ee", "Joints": "joints"}
_REWARD: dict[str, RewardType] = {"": "sparse", "Dense": "dense"}


@dataclass(frozen=True)
class _Registration:
    """What an id is made of."""

    robot: Callable[..., Robot]
    task: Callable[..., Task]
    max_episode_steps: int
    terminate_on_success: bool


_ENVS = {
    f"Panda{task}{control}{reward}-{version}": _Registration(
        robot=partial(
            Panda,
            control_type=_CONTROL[control],
            block_gripper=task in _BLOCKED_GRIPPER,
            **arguments_of(ROBOT_ARGUMENTS.get(task, NO_PAIRS), version),
            **_OWN_TASKS.get(task, {}),
        ),
        task=partial(
            _TASKS[task],
            reward_type=_REWARD[reward],
            **arguments_of(TASK_ARGUMENTS.get(task, NO_PAIRS), version),
        ),
        max_episode_steps=_TASKS[task].max_episode_steps,
        terminate_on_success=version == "v3",
    )
    for task, control, reward, version in product(_TASKS, _CONTROL, _REWARD, VERSIONS)
    if task not in _OWN_TASKS or version == "v1"
}

# Other robots at the tasks -v1; ``robot_options`` has their control types.
_ROBOTS: tuple[tuple[type[Robot], str, dict[str, Any]], ...] = (
    (Kuka, "Reach", {}),
    (XArm6, "Reach", {}),
    (XArm6Gripper, "Reach", {"block_gripper": True}),
    (XArm6Gripper, "PickAndPlace", {"finger_friction": 5.0}),
)
_ENVS |= {
    f"{robot.__name__}{task}{reward}-v1": _Registration(
        robot=partial(robot, **robot_arguments),
        task=partial(
            _TASKS[task],
            reward_type=_REWARD[reward],
            **arguments_of(TASK_ARGUMENTS.get(task, NO_PAIRS), "v1"),
        ),
        max_episode_steps=_TASKS[task].max_episode_steps,
        terminate_on_success=False,
    )
    for (robot, task, robot_arguments), reward in product(_ROBOTS, _REWARD)
}

ENV_IDS: tuple[str, ...] = tuple(_ENVS)
"""The ids that torch_panda ships: ``Panda{task}{,Joints}{,Dense}-v{1,3}`` for the tasks
of panda-gym, -v1 only for Drawer and PegInsertion,
``{Kuka,XArm6,XArm6Gripper}Reach{,Dense}-v1`` and
``XArm6GripperPickAndPlace{,Dense}-v1``."""


def register(
    env_id: str,
    *,
    robot: Callable[..., Robot],
    task: Callable[..., Task],
    max_episode_steps: int | None = None,
    terminate_on_success: bool = False,
) -> None:
    """Give a robot at a task an id, for `make` and, as ``torch_panda/{id}``, Gymnasium.

    Registering an id of one's own once more replaces it. An id is known in the process
    that has registered it: do so in a module, which workers import, too.

    Args:
        env_id: the id, such as ``"Shove-v0"``.
        robot: makes the robot: a class or a function, called with the
            ``robot_options`` of `make`.
        task: makes the task, called with the ``task_options`` of `make`.
        max_episode_steps: steps until ``truncated``; None means the task's number.
        terminate_on_success: whether success ends an episode.

    Raises:
        ValueError: the id is one that torch_panda ships, or no id for Gymnasium; or
            the number is below 1.
        TypeError: the robot or the task is not made by a call.
    """
    if env_id in ENV_IDS:
        raise ValueError(f"the id {env_id!r} is one that torch_panda ships")
    for name, factory in (("robot", robot), ("task", task)):
        if not callable(factory):
            raise TypeError(
                f"{name} must be a class or a function that makes one, got {factory!r}"
            )
    check_positive(max_episode_steps=max_episode_steps)
    steps = max_episode_steps or task().max_episode_steps
    registration = _Registration(robot, task, steps, terminate_on_success)
    try:
        _register_with_gymnasium(env_id, registration)
    except gymnasium.error.Error as error:
        raise ValueError(f"{env_id!r} cannot be an id: {error}") from None
    _ENVS[env_id] = registration


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
    task_options: Mapping[str, Any] | None = None,
    robot_options: Mapping[str, Any] | None = None,
    **options: Any,  # noqa: ANN401 (those of RobotTaskEnv)
) -> RobotTaskEnv:
    """Make the environments of an id.

    ``-v1`` follows the paper (arXiv 2106.13687) with the physical constants of
    panda-gym 1.1.0, ``-v3`` equals panda-gym 3.0.7; see `torch_panda.versions`.

    Args:
        env_id: one of `ENV_IDS`, or one that was given to `register`.
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
        task_options: arguments of the id's task, such as ``distance_threshold``.
        robot_options: arguments of the id's robot, such as ``control_type``.
        **options: the other arguments of `RobotTaskEnv`.

    Raises:
        ValueError: the id is unknown, or an argument is out of range.
        TypeError: the task or the robot has no such option.
    """
    registration = _find(env_id)
    if pixels_only and not from_pixels:
        raise ValueError("pixels_only=True needs from_pixels=True")
    options.setdefault("terminate_on_success", registration.terminate_on_success)
    if options.get("max_episode_steps") is None:
        options["max_episode_steps"] = registration.max_episode_steps
    return RobotTaskEnv(
        robot=_make(registration.robot, f"robot_options of {env_id}", robot_options),
        task=_make(registration.task, f"task_options of {env_id}", task_options),
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
        **options,
    )


def max_episode_steps(env_id: str) -> int:
    """The number of steps after which an id's episodes are truncated.

    Raises:
        ValueError: the id is unknown.
    """
    return _find(env_id).max_episode_steps


def register_with_gymnasium() -> None:
    """Register ``torch_panda/{id}`` for every id, for ``make`` and ``make_vec``.

    By name: the classes are imported when the first one is made. ``gymnasium.make``
    truncates with its own ``TimeLimit``, so that its argument ``max_episode_steps``
    works as for any other environment.
    """
    for env_id in ENV_IDS:
        _register_with_gymnasium(env_id, _ENVS[env_id])


def _register_with_gymnasium(env_id: str, registration: _Registration) -> None:
    name = f"torch_panda/{env_id}"
    gymnasium.registry.pop(name, None)  # or it would warn that it replaces it
    gymnasium.register(
        name,
        entry_point="torch_panda.gymnasium_envs:GoalEnv",
        vector_entry_point="torch_panda.gymnasium_envs:GoalVectorEnv",
        max_episode_steps=registration.max_episode_steps,
        kwargs={"env": env_id},
    )


def _find(env_id: str) -> _Registration:
    if not isinstance(env_id, str) or env_id not in _ENVS:
        close = difflib.get_close_matches(str(env_id), _ENVS, n=3)
        hint = f"did you mean {' or '.join(close)}? " if close else ""
        own = ", ".join(sorted(_ENVS.keys() - set(ENV_IDS)))
        both = ",".join(task for task in _TASKS if task not in _OWN_TASKS)
        raise ValueError(
            f"unknown environment id {env_id!r}; {hint}accepted are "
            f"Panda{{{both}}}{{,Joints}}{{,Dense}}-v{{1,3}}, "
            f"Panda{{{','.join(_OWN_TASKS)}}}{{,Joints}}{{,Dense}}-v1, "
            + ", ".join(sorted({f"{r.__name__}{task}-v1" for r, task, _ in _ROBOTS}))
            + (f" and what was registered: {own}" if own else "")
        )
    return _ENVS[env_id]


def _make(
    factory: Callable[..., Any], name: str, options: Mapping[str, Any] | None
) -> Any:  # noqa: ANN401 (a robot or a task)
    """Call what makes a robot or a task, with options that it takes."""
    if options is not None and not isinstance(options, Mapping):
        raise TypeError(f"{name} must be a mapping, got {options!r}")
    options = dict(options or {})
    signature = inspect.signature(factory)
    try:
        signature.bind(**options)
    except TypeError as error:
        accepted = ", ".join(signature.parameters) or "none"
        raise TypeError(f"{name}: {error}; accepted are {accepted}") from None
    return factory(**options)
