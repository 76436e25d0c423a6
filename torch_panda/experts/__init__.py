"""Scripted experts, which solve the tasks and give demonstrations.

An expert maps a batch of observations and goals to actions of end-effector control. It
has no state and no access to the simulation, so rollouts and collectors of any batch
size can use it. Positions are in the world frame [m]. An action of 1 displaces the
end-effector by 5 cm.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from tensordict.nn import TensorDictModule
from torch import Tensor

from torch_panda.envs import RobotTaskEnv
from torch_panda.experts import (
    drawer,
    flip,
    peg_insertion,
    pick_and_place,
    push,
    reach,
    slide,
    stack,
)
from torch_panda.registry import find_registration
from torch_panda.robots import Panda, Robot
from torch_panda.tasks import (
    Drawer,
    Flip,
    PegInsertion,
    PickAndPlace,
    Push,
    Reach,
    Slide,
    Stack,
    Task,
)

Act = Callable[[Tensor, Tensor, Tensor], Tensor]
"""A function of observation, achieved goal and desired goal, (..., size) each, to the
action."""

# Tables with at least this lateral friction count as rough. It is 0.1 in -v1 and 0.5 in
# -v3.
ROUGH_FRICTION = 0.3


class Expert(NamedTuple):
    """The functions of an expert for the Panda with end-effector control.

    Attributes:
        act: Computes the actions.
        act_on_rough_table: Computes the actions on the rough table of -v3; None means
            that ``act`` does.
        uses_fingers: Whether the expert opens and closes the gripper.
    """

    act: Act
    act_on_rough_table: Act | None = None
    uses_fingers: bool = False


EXPERTS: dict[type[Task], Expert] = {
    Reach: Expert(reach.act),
    # After a push, a cube would slide too far on the slippery table of -v1.
    Push: Expert(push.drag, push.push),
    Slide: Expert(slide.act),
    PickAndPlace: Expert(pick_and_place.act, uses_fingers=True),
    Stack: Expert(stack.act, uses_fingers=True),
    Flip: Expert(flip.act, partial(flip.act, table=flip.ROUGH), uses_fingers=True),
    Drawer: Expert(drawer.act),
    PegInsertion: Expert(peg_insertion.act),
}


def make_expert(env: str | RobotTaskEnv) -> TensorDictModule:
    """Make the scripted expert for an id or an environment.

    Args:
        env: Id or environment of a Panda with end-effector control at one of the
            shipped tasks. Its gripper must be blocked unless the expert uses it. The
            expert expects the default ``action_scale`` of 0.05 m.

    Returns:
        A module from ``observation``, ``achieved_goal`` and ``desired_goal`` to
        ``action``, for batches of any shape.

    Raises:
        ValueError: The id is unknown, or there is no expert for it.
    """
    if isinstance(env, str):
        registration = find_registration(env)
        robot, task = registration.make_robot(), registration.make_task()
        name = repr(env)
    else:
        robot, task = env.robot, env.task
        name = f"{robot} at {task}"
    act = find_expert(robot, task)
    if act is None:
        blocked, free = (
            ", ".join(t.__name__ for t, x in EXPERTS.items() if x.uses_fingers == uses)
            for uses in (False, True)
        )
        raise ValueError(
            f"no expert for {name}: there are experts for the Panda with "
            f"end-effector control, with block_gripper=True at {blocked}, and with "
            f"block_gripper=False at {free}"
        )

    def act_within_limits(*observed: Tensor) -> Tensor:
        # The environment clips actions. Demonstrations should hold the clipped ones.
        return act(*observed).clamp(-1.0, 1.0)

    return TensorDictModule(
        act_within_limits, ["observation", "achieved_goal", "desired_goal"], ["action"]
    )


def find_expert(robot: Robot, task: Task) -> Act | None:
    """Return the function of the expert for a robot and a task, or None."""
    expert = EXPERTS.get(type(task))
    if expert is None or type(robot) is not Panda or robot.control_type != "ee":
        return None
    if robot.has_free_gripper != expert.uses_fingers:
        return None
    if expert.act_on_rough_table is not None:
        assert isinstance(task, Push | Flip)
        if task.table_friction >= ROUGH_FRICTION:
            return expert.act_on_rough_table
    return expert.act
