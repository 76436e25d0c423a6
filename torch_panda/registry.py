"""The environments by name."""

import difflib
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium
import torch

from torch_panda.checks import check_positive
from torch_panda.envs import RobotTaskEnv
from torch_panda.ids import ENV_IDS, SHIPPED_ENVS, Registration, describe_ids
from torch_panda.rendering import Camera
from torch_panda.robots import Robot
from torch_panda.sensors import Sensor, read_keywords
from torch_panda.tasks import Task

_ENVS = dict(SHIPPED_ENVS)


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
    registration = Registration(robot, task, steps, terminate_on_success)
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


def _register_with_gymnasium(env_id: str, registration: Registration) -> None:
    name = f"torch_panda/{env_id}"
    gymnasium.registry.pop(name, None)  # or it would warn that it replaces it
    gymnasium.register(
        name,
        entry_point="torch_panda.gymnasium_envs:GoalEnv",
        vector_entry_point="torch_panda.gymnasium_envs:GoalVectorEnv",
        max_episode_steps=registration.max_episode_steps,
        kwargs={"env": env_id},
    )


def _find(env_id: str) -> Registration:
    if not isinstance(env_id, str) or env_id not in _ENVS:
        close = difflib.get_close_matches(str(env_id), _ENVS, n=3)
        hint = f"did you mean {' or '.join(close)}? " if close else ""
        own = ", ".join(sorted(_ENVS.keys() - SHIPPED_ENVS.keys()))
        raise ValueError(
            f"unknown environment id {env_id!r}; {hint}accepted are {describe_ids()}"
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
