"""Registry: ids of environments, `make` and `register`."""

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from types import MappingProxyType
from typing import Any, NamedTuple

import gymnasium

from torch_panda.arguments import argument_names, check_names, load_class, suggest
from torch_panda.bullet.shapes import BLUE
from torch_panda.checks import check_positive
from torch_panda.envs import RobotTaskEnv
from torch_panda.rendering import Camera
from torch_panda.robots import Panda, Robot
from torch_panda.sensors import Sensor, read_keywords
from torch_panda.tasks import Task
from torch_panda.tasks.peg_insertion import GRASP_WIDTH

Options = Mapping[str, Any]


class Registration(NamedTuple):
    """How to make the robot and the task of an id.

    Attributes:
        env_id: The id, such as "PandaPush-v1".
        robot: Class or function that makes the robot.
        task: Class or function that makes the task.
        max_episode_steps: Number of steps until ``truncated``.
        terminate_on_success: Whether success ends an episode.
    """

    env_id: str
    robot: Callable[..., Robot]
    task: Callable[..., Task]
    max_episode_steps: int
    terminate_on_success: bool = False

    def make_robot(self, options: Options | None = None) -> Robot:
        """Make the robot of the id, with options that replace its arguments.

        Raises:
            TypeError: The robot does not have one of these arguments.
        """
        return self.robot(**options or {})

    def make_task(self, options: Options | None = None) -> Task:
        """Make the task of the id; see `make_robot`."""
        return self.task(**options or {})


class Family(NamedTuple):
    """The ids of one robot at one task: ``{robot}{task}{,Joints}{,Dense}-v{1,3}``.

    The names in the ids are those of the classes. The defaults of a task are those of
    ``-v1``.

    Attributes:
        robot: Class of the robot.
        task: Class of the task.
        robot_options: Arguments of the robot.
        v3_task: Arguments of the task that ``-v3`` changes; None if there is no
            ``-v3``.
        v3_robot: Arguments of the robot that ``-v3`` changes.
        joints: Whether there are ids with joint control.
    """

    robot: type[Robot]
    task: type[Task]
    robot_options: Options = MappingProxyType({})
    v3_task: Options | None = None
    v3_robot: Options = MappingProxyType({})
    joints: bool = True

    def registrations(self) -> Iterator[Registration]:
        """One registration for each id."""
        controls = ("", "Joints") if self.joints else ("",)
        versions = ("v1",) if self.v3_task is None else ("v1", "v3")
        for control, reward, version in product(controls, ("", "Dense"), versions):
            robot_options = dict(self.robot_options)
            task_options: dict[str, Any] = {}
            if version == "v3":
                robot_options |= self.v3_robot
                task_options |= self.v3_task or {}
            if control == "Joints":
                robot_options["control_type"] = "joints"
            if reward == "Dense":
                task_options["reward_type"] = "dense"
            name = f"{self.robot.__name__}{self.task.__name__}"
            yield Registration(
                f"{name}{control}{reward}-{version}",
                partial(self.robot, **robot_options),
                partial(self.task, **task_options),
                self.task.max_episode_steps,
                terminate_on_success=version == "v3",
            )


BLOCKED = {"block_gripper": True}
ROUGH_FINGERS = {"finger_friction": 5.0}
# As in panda-gym 3.0.7. The default is the URDF's value, 0.1.
SPIN_FRICTION = {"finger_spinning_friction": 0.001}

# Load a robot or a task that is given as ``module:Class``.
_robot = partial(load_class, "torch_panda.robots")
_task = partial(load_class, "torch_panda.tasks")

# A new task or robot needs its file and a line here. The page tasks/README.md shows the
# numbers of both versions side by side, with their sources.
FAMILIES = (
    Family(
        Panda,
        _task("reach:Reach"),
        BLOCKED,
        v3_task={"table_friction": 0.5},
        v3_robot=SPIN_FRICTION,
    ),
    Family(
        Panda,
        _task("push:Push"),
        BLOCKED,
        v3_task={"table_friction": 0.5, "object_mass": 1.0},
        v3_robot=SPIN_FRICTION,
    ),
    Family(
        Panda,
        _task("slide:Slide"),
        BLOCKED,
        v3_task={
            "table_friction": 0.5,
            "object_mass": 1.0,
            "object_friction": 0.04,
            "goal_xy_range": 0.3,
            "goal_x_offset": 0.4,
            "table_length": 1.4,
            "table_x_offset": -0.1,
        },
        v3_robot=SPIN_FRICTION,
    ),
    Family(
        Panda,
        _task("pick_and_place:PickAndPlace"),
        ROUGH_FINGERS,
        v3_task={"table_friction": 0.5, "object_mass": 1.0, "object_friction": 0.5},
        v3_robot={"finger_friction": 1.0, **SPIN_FRICTION},
    ),
    Family(
        Panda,
        _task("stack:Stack"),
        ROUGH_FINGERS,
        v3_task={
            "table_friction": 0.5,
            "object_mass": (2.0, 1.0),
            "object_friction": 0.5,
            "distance_threshold": 0.1,
            "per_object": False,
            "lower_color": BLUE,
        },
        v3_robot={"finger_friction": 1.0, **SPIN_FRICTION},
    ),
    # panda-gym 1.1.0 has no Flip, so Flip-v1 has the fingers of 3.0.7.
    Family(Panda, _task("flip:Flip"), SPIN_FRICTION, v3_task={"table_friction": 0.5}),
    Family(Panda, _task("drawer:Drawer"), BLOCKED),
    Family(
        Panda,
        _task("peg_insertion:PegInsertion"),
        BLOCKED | ROUGH_FINGERS | {"fingers_width": GRASP_WIDTH},
    ),
    Family(_robot("kuka:Kuka"), _task("reach:Reach"), joints=False),
    Family(_robot("xarm:XArm6"), _task("reach:Reach"), joints=False),
    Family(_robot("xarm:XArm6Gripper"), _task("reach:Reach"), BLOCKED, joints=False),
    Family(
        _robot("xarm:XArm6Gripper"),
        _task("pick_and_place:PickAndPlace"),
        ROUGH_FINGERS,
        joints=False,
    ),
)

# Ids in `gymnasium.make` begin with it.
GYMNASIUM_PREFIX = "torch_panda/"
_REGISTRATIONS = {
    registration.env_id: registration
    for family in FAMILIES
    for registration in family.registrations()
}

ENV_IDS: tuple[str, ...] = tuple(_REGISTRATIONS)
"""The ids that torch_panda ships, which are those of `FAMILIES`."""

# Arguments that `make` sets, and names from other libraries, with the fix for each.
_ADVICE = {
    "n_envs": "use num_envs",
    "render_mode": "use env.render() for pictures, or env.open_viewer() to watch in a "
    "browser",
    "robot": "use an id, or RobotTaskEnv(robot=..., task=...)",
    "task": "use an id, or RobotTaskEnv(robot=..., task=...)",
    "observe_state": "use pixels_only",
}


def make(
    env_id: str,
    *,
    from_pixels: bool = False,
    pixels_only: bool = False,
    depth: bool = False,
    segmentation: bool = False,
    camera: Camera | None = None,
    render_size: int | tuple[int, int] | None = None,
    sensors: Sequence[Sensor | str] = (),
    task_options: Options | None = None,
    robot_options: Options | None = None,
    **options: Any,  # noqa: ANN401 (options of RobotTaskEnv)
) -> RobotTaskEnv:
    """Make the environments of an id.

    For the tasks of the paper (arXiv 2106.13687), ``-v1`` follows the paper, with the
    physical constants of panda-gym 1.1.0, and ``-v3`` follows panda-gym 3.0.7.

    Args:
        env_id: One of `ENV_IDS`, or an id that was registered with `register`.
        from_pixels: Observe ``pixels``, uint8 (*batch, height, width, 3).
        pixels_only: Leave ``observation`` out; the goals stay.
        depth: Observe ``depth``, float32 (*batch, height, width, 1) [m].
        segmentation: Observe ``segmentation``, int32 (*batch, height, width, 1): body
            ids that ``segmentation_ids`` names; see `CameraSensor`.
        camera: Camera of these pictures; None means panda-gym's view in 64 x 64 pixels.
        render_size: Height and width of these pictures [pixels], or one number for
            both; None means the size of the camera.
        sensors: Names of sensors ("joint_state", "wrist_force_torque",
            "finger_contact", "joint_torque"), or `Sensor` objects.
        task_options: Arguments of the task, such as ``distance_threshold``.
        robot_options: Arguments of the robot, such as ``control_type``.
        **options: Arguments of `RobotTaskEnv`, such as ``num_envs``, ``num_threads``,
            ``seed`` and ``device``.

    Raises:
        ValueError: The id is unknown, or an argument is out of range.
        TypeError: `make`, the task or the robot does not have such an argument.
    """
    registration = find_registration(env_id)
    _check_options(registration, options)
    if pixels_only and not from_pixels:
        raise ValueError("pixels_only=True needs from_pixels=True")
    options.setdefault("terminate_on_success", registration.terminate_on_success)
    if options.get("max_episode_steps") is None:
        options["max_episode_steps"] = registration.max_episode_steps
    env = RobotTaskEnv(
        robot=registration.make_robot(robot_options),
        task=registration.make_task(task_options),
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
    env._env_id = env_id
    return env


def register(
    env_id: str,
    *,
    robot: Callable[..., Robot],
    task: Callable[..., Task],
    max_episode_steps: int | None = None,
    terminate_on_success: bool = False,
) -> None:
    """Register an id for `make` and, as ``torch_panda/{env_id}``, for Gymnasium.

    The id is known in the process that registered it. Call `register` in a module that
    worker processes import too. Registering an id again replaces it.

    Args:
        env_id: The id, such as ``"Shove-v0"``.
        robot: Class or function that makes the robot. It is called with the
            ``robot_options`` of `make`.
        task: Class or function that makes the task. It is called with the
            ``task_options`` of `make`.
        max_episode_steps: Number of steps until ``truncated``; None means the task's
            number.
        terminate_on_success: Whether success ends an episode.

    Raises:
        ValueError: The id belongs to torch_panda or is invalid for Gymnasium, or
            ``max_episode_steps`` is below 1.
        TypeError: ``robot`` or ``task`` cannot be called, or ``max_episode_steps`` is
            None and ``task`` needs arguments.
    """
    if env_id in ENV_IDS:
        raise ValueError(
            f"{env_id!r} is an id that torch_panda ships; choose another one"
        )
    for name, maker in (("robot", robot), ("task", task)):
        if not callable(maker):
            raise TypeError(
                f"{name} must be a class or a function, got {maker!r}: pass the class "
                f"or a function that makes one"
            )
    check_positive(max_episode_steps=max_episode_steps)
    steps = max_episode_steps or task().max_episode_steps
    registration = Registration(env_id, robot, task, steps, terminate_on_success)
    try:
        _register_with_gymnasium(registration)
    except gymnasium.error.Error as error:
        raise ValueError(f"{env_id!r} cannot be an id: {error}") from None
    _REGISTRATIONS[env_id] = registration


def is_registered(env_id: str) -> bool:
    """Whether an id is shipped, or was registered with `register`."""
    return env_id in _REGISTRATIONS


def find_registration(env_id: str) -> Registration:
    """Return the registration of an id.

    Raises:
        ValueError: The id is unknown.
    """
    if isinstance(env_id, str) and is_registered(env_id):
        return _REGISTRATIONS[env_id]
    own_id = str(env_id).removeprefix(GYMNASIUM_PREFIX)
    if is_registered(own_id):
        raise ValueError(f"{env_id!r} is the id in gymnasium.make: use {own_id!r} here")
    if isinstance(env_id, str) and env_id in gymnasium.registry:
        raise ValueError(
            f"an environment of torch_panda is needed here, but {env_id} is one of "
            "Gymnasium, without experts and data sets"
        )
    hint = suggest(str(env_id), _REGISTRATIONS)
    own = ", ".join(sorted(_REGISTRATIONS.keys() - set(ENV_IDS)))
    raise ValueError(
        f"unknown environment id {env_id!r}; {hint}accepted ids are {_id_patterns()}"
        + (f"; registered ids are {own}" if own else "")
        + "; to use an id of your own, import the module that registers it in every "
        "process (in commands: --import)"
    )


def max_episode_steps(env_id: str) -> int:
    """Number of steps after which the episodes of an id are truncated.

    Raises:
        ValueError: The id is unknown.
    """
    return find_registration(env_id).max_episode_steps


def register_all_with_gymnasium() -> None:
    """Register ``torch_panda/{id}`` with Gymnasium for all shipped ids."""
    for env_id in ENV_IDS:
        _register_with_gymnasium(_REGISTRATIONS[env_id])


def _register_with_gymnasium(registration: Registration) -> None:
    """Register an id for ``gymnasium.make`` and ``make_vec``.

    The entry points are strings, so the classes are imported when the first environment
    is made. Gymnasium's ``TimeLimit`` truncates, so ``gymnasium.make`` accepts another
    ``max_episode_steps``.
    """
    name = GYMNASIUM_PREFIX + registration.env_id
    gymnasium.registry.pop(name, None)  # Gymnasium warns of ids that it replaces.
    gymnasium.register(
        name,
        entry_point="torch_panda.gymnasium_envs:GoalEnv",
        vector_entry_point="torch_panda.gymnasium_envs:GoalVectorEnv",
        max_episode_steps=registration.max_episode_steps,
        kwargs={"env": registration.env_id},
    )


def _id_patterns() -> str:
    """Patterns of the shipped ids, for errors."""
    tasks: dict[tuple[str, str], list[str]] = {}
    for family in FAMILIES:
        suffix = "{,Joints}{,Dense}" if family.joints else "{,Dense}"
        suffix += "-v1" if family.v3_task is None else "-v{1,3}"
        key = family.robot.__name__, suffix
        tasks.setdefault(key, []).append(family.task.__name__)
    return ", ".join(
        f"{robot}{names[0]}{suffix}"
        if len(names) == 1
        else f"{robot}{{{','.join(names)}}}{suffix}"
        for (robot, suffix), names in tasks.items()
    )


def _check_options(registration: Registration, options: Options) -> None:
    """Refuse options of `make` that `RobotTaskEnv` does not have.

    Raises:
        TypeError: An option is unknown. The error says what to use instead.
    """
    names = (
        *inspect.signature(make).parameters,
        *inspect.signature(RobotTaskEnv.__init__).parameters,
    )
    hidden = {"self", "options", *_ADVICE}
    accepted = [name for name in dict.fromkeys(names) if name not in hidden]
    unknown = [name for name in options if name not in accepted]
    if not unknown:
        return
    advice = dict(_ADVICE)
    for argument, example in (
        ("task_options", registration.make_task()),
        ("robot_options", registration.make_robot()),
    ):
        for name in {*argument_names(type(example))} & {*unknown}:
            advice[name] = f"use {argument}={{{name!r}: {options[name]!r}}}"
    dense_id = "Dense-".join(registration.env_id.rsplit("-", 1))
    if "reward_type" in advice and dense_id in ENV_IDS:
        advice["reward_type"] += f", or the id {dense_id} for dense rewards"
    check_names("make", unknown, accepted, advice)
