"""Geometry of the tasks: where positions are in observations, and the symmetry."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

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
from torch_panda.tasks import Task
from torch_panda.tasks.base import Quantity

OBSERVED = ("observation", "desired_goal")

# Factors that mirror a quantity in the plane y = 0, in which robot and table are
# symmetric.
_MIRROR: dict[Quantity, tuple[float, ...]] = {
    "position": (1.0, -1.0, 1.0),
    "velocity": (1.0, -1.0, 1.0),
    "euler_angles": (-1.0, 1.0, -1.0),
    "angular_velocity": (-1.0, 1.0, -1.0),
    "quaternion": (-1.0, 1.0, -1.0, 1.0),
    "number": (1.0,),
}

WIDTH: Quantity = "number"  # of the fingers


class Part(NamedTuple):
    """A quantity in an observation or in a goal.

    Attributes:
        quantity: What it is.
        start: Index of its first entry.
    """

    quantity: Quantity
    start: int


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
    """The geometry of an environment; None if its task does not declare its layout."""
    robot, task = env.robot, env.task
    if task.observation_layout is None or task.goal_entries is None:
        return None
    fingers = (WIDTH,) * (robot.observation_dim - 6)
    parts = locate(("position", "velocity", *fingers, *task.observation_layout))
    size = sum(len(_MIRROR[part.quantity]) for part in parts)
    goals = locate_goals(parts, task, first=robot.observation_dim)
    goal_size = sum(len(_MIRROR[part.quantity]) for part, _ in goals)
    sizes = tuple(env.observation_spec[key].shape[-1] for key in OBSERVED)
    if (size, goal_size) != sizes:  # a subclass changed its observation or its goals
        return None

    _, *objects = (part.start for part in parts if part.quantity == "position")
    positions = [goal for goal in goals if goal[0].quantity == "position"]
    rotations = [goal for goal in goals if goal[0].quantity == "quaternion"]
    # An object is seen from the hand, and a goal from the object that should go there.
    pairs = [(0, start) for start in objects]
    pairs += [(part.start, size + start) for part, start in positions]
    return Geometry(
        later=tuple(there + axis for _, there in pairs for axis in range(3)),
        earlier=tuple(here + axis for here, _ in pairs for axis in range(3)),
        observation=tuple(x for part in parts for x in _MIRROR[part.quantity]),
        goal=tuple(x for part, _ in goals for x in _MIRROR[part.quantity]),
        action=(*_MIRROR["position"], *(1.0 for _ in fingers))
        if robot.control_type == "ee"
        else None,
        positions=(0, *objects),
        goal_positions=tuple(start for _, start in positions),
        goal_height=task.drawn_goal_height,
        orientation=rotations[0][0].start if rotations else None,
    )


def locate(layout: Sequence[Quantity]) -> list[Part]:
    """The quantities of an observation with the indices at which they start."""
    parts, start = [], 0
    for quantity in layout:
        parts.append(Part(quantity, start))
        start += len(_MIRROR[quantity])
    return parts


def locate_goals(
    parts: Iterable[Part], task: Task, first: int
) -> list[tuple[Part, int]]:
    """The quantities that a goal consists of.

    Args:
        parts: Quantities of the observation.
        task: The task.
        first: Index of the first entry of the task in an observation.

    Returns:
        Each quantity in the observation, and the index at which it starts in a goal.
    """
    assert task.goal_entries is not None
    offset = first if task.goal_entries.part == "task" else 0
    entries = [offset + index for index in task.goal_entries.indices]
    return [
        (part, entries.index(part.start)) for part in parts if part.start in entries
    ]
