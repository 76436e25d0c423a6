"""The ids that torch_panda ships, and what each is made of."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any

from torch_panda.robots import (
    ControlType,
    Kuka,
    Panda,
    Robot,
    XArm6,
    XArm6Gripper,
)
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
class Registration:
    """What an id is made of."""

    robot: Callable[..., Robot]
    task: Callable[..., Task]
    max_episode_steps: int
    terminate_on_success: bool


SHIPPED_ENVS = {
    f"Panda{task}{control}{reward}-{version}": Registration(
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
SHIPPED_ENVS |= {
    f"{robot.__name__}{task}{reward}-v1": Registration(
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

ENV_IDS: tuple[str, ...] = tuple(SHIPPED_ENVS)
"""The ids that torch_panda ships: ``Panda{task}{,Joints}{,Dense}-v{1,3}`` for the tasks
of panda-gym, -v1 only for Drawer and PegInsertion,
``{Kuka,XArm6,XArm6Gripper}Reach{,Dense}-v1`` and
``XArm6GripperPickAndPlace{,Dense}-v1``."""


def describe_ids() -> str:
    """The patterns of the shipped ids, for errors."""
    both = ",".join(task for task in _TASKS if task not in _OWN_TASKS)
    others = sorted({f"{robot.__name__}{task}" for robot, task, _ in _ROBOTS})
    return (
        f"Panda{{{both}}}{{,Joints}}{{,Dense}}-v{{1,3}}, "
        f"Panda{{{','.join(_OWN_TASKS)}}}{{,Joints}}{{,Dense}}-v1, "
        f"{{{','.join(others)}}}{{,Dense}}-v1"
    )
