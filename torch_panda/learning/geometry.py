"""What an agent may know of the shipped tasks: where things are, and the symmetry."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torch_panda.envs import RobotTaskEnv
from torch_panda.experts.cube_orientations import (
    STRAIGHT,
    compose,
    inverse,
    same_half,
    straighten,
    to_matrix,
)
from torch_panda.tasks import Drawer, PegInsertion, Slide, Task

# Factors that mirror a quantity in the plane y = 0, in which robot and table are
# symmetric.
_POINT = (1.0, -1.0, 1.0)
_ANGLES = (-1.0, 1.0, -1.0)
_QUATERNION = (-1.0, 1.0, -1.0, 1.0)
_FACTORS = {
    "position": _POINT,
    "velocity": _POINT,
    "angles": _ANGLES,
    "angular velocity": _ANGLES,
    "quaternion": _QUATERNION,
    "number": (1.0,),
}
_OBJECT = ("position", "angles", "velocity", "angular velocity")

# [m]. Slide draws goals 1.5 cm above where its puck can be, by which networks would
# tell them from hindsight goals.
SLIDE_GOAL_HEIGHT = 0.03


@dataclass(frozen=True)
class Geometry:
    """Of a task, by the layout of its observations and goals.

    Attributes:
        later: indices into (observation, goal), of each object and each goal.
        earlier: of the end-effector for an object, of the object for its goal.
        observation: factors that mirror an observation, (observation size,).
        goal: factors that mirror a goal, (goal size,).
        action: factors that mirror an action; None with joint control.
        positions: where positions begin in an observation.
        goal_positions: where they begin in a goal.
        goal_height: at which goals are shown to networks that see differences of
            positions [m]; None shows them where they are.
        orientation: where the quaternion of the object begins in an observation, if
            goals are orientations; else None.
    """

    later: tuple[int, ...]
    earlier: tuple[int, ...]
    observation: tuple[float, ...]
    goal: tuple[float, ...]
    action: tuple[float, ...] | None
    positions: tuple[int, ...]
    goal_positions: tuple[int, ...]
    goal_height: float | None
    orientation: int | None

    def differences(self, observation: Tensor, goal: Tensor) -> Tensor:
        """Objects from the end-effector and goals from objects, (..., n) [m]."""
        inputs = torch.cat((observation, goal), -1)
        return inputs[..., self.later] - inputs[..., self.earlier]

    def turns(self, observation: Tensor, goal: Tensor) -> tuple[Tensor, ...]:
        """Orientations as they are for a cube without colours, which has 24 equal ones.

        Returns:
            the observation with the smallest of the 24; the turn from the cube's
            orientation to the goal's, a quaternion (..., 4), and its matrix (..., 9);
            how like the 24 turns that lay a cube straight that from the nearest
            straight orientation to the goal's is, from 0 to 1, (..., 24).
        """
        assert self.orientation is not None
        place = slice(self.orientation, self.orientation + 4)
        cube = observation[..., place]
        observation = observation.clone()
        back = inverse(straighten(cube))
        observation[..., place] = same_half(compose(cube, back))
        turn = same_half(compose(goal, inverse(cube)))
        likeness = (compose(goal, back) @ STRAIGHT.to(goal).T).square()
        return observation, turn, to_matrix(turn).flatten(-2), likeness


def read_geometry(env: RobotTaskEnv) -> Geometry | None:
    """The geometry of an environment; None if the layout of its task is unknown."""
    robot, task = env.robot, env.task
    gripper = ("number",) * (robot.observation_dim - 6)
    layout = ("position", "velocity", *gripper, *_task_layout(task))
    sizes = [len(_FACTORS[kind]) for kind in layout]
    places = [sum(sizes[:k]) for k in range(len(layout))]
    size = sum(sizes)
    if size != robot.observation_dim + task.observation_dim:
        return None

    positions = zip(places, layout, strict=True)
    _, *starts = (place for place, kind in positions if kind == "position")
    rotates = task.goal_dim == 4  # Flip: orientations are quaternions
    goals = () if rotates else tuple(range(0, task.goal_dim, 3))
    # What an object is seen from, and a goal: the hand, and what is to be moved there.
    pairs = [(0, start) for start in starts]
    pairs += [
        (here, size + goal) for here, goal in zip(starts or (0,), goals, strict=False)
    ]
    return Geometry(
        later=tuple(there + axis for _, there in pairs for axis in range(3)),
        earlier=tuple(here + axis for here, _ in pairs for axis in range(3)),
        observation=tuple(factor for kind in layout for factor in _FACTORS[kind]),
        goal=_QUATERNION if rotates else _POINT * len(goals),
        action=(*_POINT, *(1.0 for _ in gripper))
        if robot.control_type == "ee"
        else None,
        positions=(0, *starts),
        goal_positions=goals,
        goal_height=SLIDE_GOAL_HEIGHT if isinstance(task, Slide) else None,
        orientation=starts[0] + 3 if rotates else None,
    )


def _task_layout(task: Task) -> tuple[str, ...]:
    """What the numbers of a task's observation are, by names of `_FACTORS`."""
    match task:
        case Drawer():
            return ("position", "number", "number")
        case PegInsertion():
            return (*_OBJECT, "position")
    if task.goal_dim == 4:
        return ("position", "quaternion", "velocity", "angular velocity")
    return _OBJECT * (task.observation_dim // 12)
