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
    """Layout and symmetry of observations, goals and actions.

    Attributes:
        points: Indices into (observation, goal) of the positions of objects and goals.
        origins: Indices of the positions that are subtracted from them: those of the
            end-effector for objects, and those of objects for their goals.
        observation: Factors that mirror an observation, (observation size,).
        goal: Factors that mirror a goal, (goal size,).
        action: Factors that mirror an action, (action size,); None for joint control.
        positions: Indices at which positions start in an observation.
        goal_positions: Indices at which positions start in a goal.
        goal_height: Height that replaces the height of all goals if the networks see
            differences of positions [m]; None leaves the goals as they are.
        orientation: Index at which the object's quaternion starts in an observation, if
            goals are orientations; else None.
    """

    points: tuple[int, ...]
    origins: tuple[int, ...]
    observation: tuple[float, ...]
    goal: tuple[float, ...]
    action: tuple[float, ...] | None
    positions: tuple[int, ...]
    goal_positions: tuple[int, ...]
    goal_height: float | None
    orientation: int | None

    def differences(self, observation: Tensor, goal: Tensor) -> Tensor:
        """Offsets of objects from the hand and of goals from objects, (..., n) [m]."""
        inputs = torch.cat((observation, goal), -1)
        return inputs[..., self.points] - inputs[..., self.origins]

    def turns(self, observation: Tensor, goal: Tensor) -> tuple[Tensor, ...]:
        """Orientations of a cube without colours, of which 24 look alike.

        Returns:
            The observation, in which the smallest rotation of the 24 that look alike
            replaces the cube's. The rotation from the cube to the goal, a quaternion
            (..., 4). The matrix of this rotation, (..., 9). The similarity of the
            rotation from the cube's nearest straight orientation to the goal with each
            of the 24 straight orientations, from 0 to 1, (..., 24).
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
    # An object is seen from the hand, and a goal from the object that should go to it.
    pairs = [(0, start) for start in objects]
    pairs += [(part.start, size + start) for part, start in positions]
    return Geometry(
        points=tuple(point + axis for _, point in pairs for axis in range(3)),
        origins=tuple(origin + axis for origin, _ in pairs for axis in range(3)),
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
