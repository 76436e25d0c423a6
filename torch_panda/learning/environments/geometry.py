"""Geometry of a task: where its observations hold positions, and how to mirror them."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import EnvBase

from torch_panda.envs import RobotTaskEnv
from torch_panda.envs.goal_observation import find_goal_indices
from torch_panda.experts.cube_orientations import (
    compose,
    same_half,
    straight_orientations,
    straighten,
    to_matrix,
)
from torch_panda.robots import Robot
from torch_panda.rotations import inverse
from torch_panda.tasks import Task
from torch_panda.tasks.base import Quantity

# Factors that mirror a quantity across the plane y = 0, about which robot and table are
# symmetric.
_MIRROR: dict[Quantity, tuple[float, ...]] = {
    "position": (1.0, -1.0, 1.0),
    "velocity": (1.0, -1.0, 1.0),
    "euler_angles": (-1.0, 1.0, -1.0),
    "angular_velocity": (-1.0, 1.0, -1.0),
    "quaternion": (-1.0, 1.0, -1.0, 1.0),
    "cube_quaternion": (-1.0, 1.0, -1.0, 1.0),
    "number": (1.0,),
}

AXES = 3  # numbers of a position
WIDTH: Quantity = "number"  # the distance between the fingers is one number


# Rollouts, and steps of each, with which `find_geometry` looks at a task.
_PROBE_ROLLOUTS, _PROBE_STEPS = 4, 30
_SAME = 1e-5  # largest difference of equal numbers
# Steps over which the change of a position is compared with the actions, and the least
# correlation of the two along each axis.
_PROBE_WINDOW = 10
_FOLLOWS = 0.6
# Distances from the lowest and the highest start of an object to the ends of the box of
# points, along x, y and z [m].
_MARGINS = ((0.05, 0.05, 0.02), (0.05, 0.05, 0.06))


class Part(NamedTuple):
    """A quantity, such as a position, in an observation or in a goal.

    Attributes:
        quantity: The quantity.
        start: Its first column.
    """

    quantity: Quantity
    start: int


@dataclass(frozen=True)
class Geometry:
    """Layout and symmetry of observations, goals and actions.

    The robot and the table are symmetric about the plane y = 0. Multiplying a vector by
    its factors, which are 1 and -1, mirrors it across this plane.

    Attributes:
        points: Indices of the coordinates of all objects and goals, in the
            concatenation of observation and goal.
        origins: Indices of the coordinates that are subtracted from ``points``: the
            hand's for an object, and the object's (in Reach the hand's) for its goal.
        observation: Factors that mirror an observation, (observation size,).
        goal: Factors that mirror a goal, (goal size,).
        action: Factors that mirror an action, (action size,); None for joint control.
        positions: First column of each position in an observation. The first one is
            the hand's. If the hand is unknown, there are none.
        goal_positions: First column of each position in a goal.
        goal_height: Height of all goals that the task draws [m]. Networks that see
            differences of positions get this height for all goals, because achieved
            goals are lower. None leaves the goals unchanged.
        orientation: First column of the object's quaternion in an observation, if a
            goal is the quaternion of a cube and nothing else; else None.
        box: Lowest and highest (x, y, z) of the box in which the exploration "points"
            draws its points [m]; None means the box of the shipped tasks.
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
    box: tuple[tuple[float, ...], tuple[float, ...]] | None = None

    def differences(self, observation: Tensor, goal: Tensor) -> Tensor:
        """Offsets from the hand to objects and from objects to goals, (..., n) [m]."""
        inputs = torch.cat((observation, goal), -1)
        # The three coordinates of a position follow each other.
        starts = zip(self.points[::AXES], self.origins[::AXES], strict=True)
        differences = [
            inputs[..., point : point + AXES] - inputs[..., origin : origin + AXES]
            for point, origin in starts
        ]
        return torch.cat((*differences, inputs[..., :0]), -1)

    def owners(self) -> tuple[list[int | None], list[int | None]]:
        """The objects to which the numbers of observation and goal belong.

        An observation has the numbers of an object from its position up to the next
        position, of another object or of the hand. Its part of the goal belongs to it,
        too, and so do the offsets that lead to it or from it. If the hand is unknown,
        no number belongs to an object.

        Returns:
            For each number of the concatenation of observation and goal, and for each
            coordinate of `differences`: the first column of the object's position, or
            None if the number belongs to no object.
        """
        size = len(self.observation)
        inputs: list[int | None] = [None] * (size + len(self.goal))
        for start in sorted(self.positions):
            owner = None if start == self.positions[0] else start
            inputs[start:size] = [owner] * (size - start)
        offsets: list[int | None] = []
        for point, origin in zip(self.points, self.origins, strict=True):
            if point >= size:
                inputs[point] = inputs[origin]
            offsets.append(inputs[point])
        return inputs, offsets

    def rotations(self, observation: Tensor, goal: Tensor) -> tuple[Tensor, ...]:
        """Express the orientations of cube and goal as inputs of the networks.

        A cube without colours looks the same in 24 orientations. Equal looks should
        give equal inputs, because the fingers grasp the cube in the same way.

        Returns:
            Four tensors:

            - The observation, in which the cube's quaternion is replaced by the
              smallest rotation that looks the same, (..., observation size).
            - The rotation from the cube to the goal, quaternion xyzw, (..., 4).
            - The matrix of this rotation, (..., 9).
            - The rotation from the cube's nearest straight orientation to the goal, as
              its similarity with each of the 24 straight orientations, from 0 to 1,
              (..., 24).
        """
        assert self.orientation is not None
        columns = slice(self.orientation, self.orientation + 4)
        cube = observation[..., columns]
        observation = observation.clone()
        inverse_straight = inverse(straighten(cube))
        observation[..., columns] = same_half(compose(cube, inverse_straight))
        to_goal = same_half(compose(goal, inverse(cube)))
        straight_to_goal = compose(goal, inverse_straight)
        straight = straight_orientations(goal.dtype, goal.device)
        similarity = (straight_to_goal @ straight.T).square()
        return observation, to_goal, to_matrix(to_goal).flatten(-2), similarity


def split_goal(size: int) -> list[slice]:
    """The parts of a goal: the position of each object, or the whole goal.

    A goal is a whole if its size is not a multiple of the three numbers of a position.
    """
    width = size if size % AXES else AXES
    return [slice(start, start + width) for start in range(0, size, width)]


def observes_hand_first(robot: Robot) -> bool:
    """Whether a robot observes what `Robot` does, which begins with the hand."""
    return type(robot).observation is Robot.observation


def declares_layout(robot: Robot, task: Task) -> bool:
    """Whether a task declares a layout that fits its observations and goals."""
    return find_parts(robot, task) is not None


def find_parts(
    robot: Robot, task: Task
) -> tuple[list[Part], list[tuple[Part, int]]] | None:
    """Find the quantities in the observations and goals of a task that declares them.

    Returns:
        Each quantity of an observation, and each of a goal: as a part of the
        observation, with its first column in the goal, in the order of the goal. None
        if the task does not declare ``observation_layout`` and ``goal_entries``, if
        they do not fit, or if a subclass has changed the functions that they describe.
    """
    indices, layout = find_goal_indices(robot, task), task.observation_layout
    if indices is None or layout is None or not observes_hand_first(robot):
        return None
    fingers = (WIDTH,) * (robot.observation_dim - 6)
    parts, start = [], 0
    for quantity in ("position", "velocity", *fingers, *layout):
        parts.append(Part(quantity, start))
        start += len(_MIRROR[quantity])
    goals = [(x, indices.index(x.start)) for x in parts if x.start in indices]
    goals.sort(key=lambda goal: goal[1])
    columns = [x.start + k for x, _ in goals for k in range(len(_MIRROR[x.quantity]))]
    fits = start == robot.observation_dim + task.observation_dim
    return (parts, goals) if fits and tuple(columns) == indices else None


def read_geometry(env: RobotTaskEnv) -> Geometry | None:
    """Return the geometry of an environment; None if its task declares none that fits.

    See `find_parts`.
    """
    robot, task = env.robot, env.task
    found = find_parts(robot, task)
    if found is None:
        return None
    parts, goals = found
    size = robot.observation_dim + task.observation_dim
    if env.observation_spec["desired_goal"].shape[-1] != task.goal_dim:
        return None  # goals are full observations

    _, *objects = (part.start for part in parts if part.quantity == "position")
    positions = [goal for goal in goals if goal[0].quantity == "position"]
    # Pairs of origin and point: the hand and an object, or an object and its goal. The
    # hand's position is at index 0.
    pairs = [(0, start) for start in objects]
    pairs += [(part.start, size + start) for part, start in positions]
    return Geometry(
        points=_coordinates(point for _, point in pairs),
        origins=_coordinates(origin for origin, _ in pairs),
        observation=tuple(x for part in parts for x in _MIRROR[part.quantity]),
        goal=tuple(x for part, _ in goals for x in _MIRROR[part.quantity]),
        action=(*_MIRROR["position"], *(1.0,) * (robot.observation_dim - 6))
        if robot.control_type == "ee"
        else None,
        positions=(0, *objects),
        goal_positions=tuple(start for _, start in positions),
        goal_height=task.sampled_goal_height,
        orientation=goals[0][0].start
        if [part.quantity for part, _ in goals] == ["cube_quaternion"]
        else None,
    )


def _coordinates(starts: Iterable[int]) -> tuple[int, ...]:
    """The three columns of each position, from its first column."""
    return tuple(start + axis for start in starts for axis in range(AXES))


class Hand(NamedTuple):
    """Where an environment observes the hand, and how actions move it.

    Attributes:
        column: First of the three columns of ``observation`` with its position.
        action_scale: Displacement that an action of 1 causes in one step.
    """

    column: int
    action_scale: float


def probe(env: EnvBase) -> TensorDict:
    """Play some episodes with random actions, for `find_geometry` and `find_hand`.

    Returns:
        Transitions [rollouts, steps].
    """
    played = [
        env.rollout(_PROBE_STEPS, break_when_any_done=False)
        for _ in range(_PROBE_ROLLOUTS)
    ]
    return TensorDict.stack(played).reshape(-1, _PROBE_STEPS)


def find_hand(rollouts: TensorDict) -> Hand | None:
    """Find the hand of an environment whose first three actions displace it.

    Its position is the three successive observed numbers that follow these actions
    best. A velocity follows them for a few steps only, so the change of a number over
    `_PROBE_WINDOW` steps is compared with the sum of the actions.

    Args:
        rollouts: Transitions with random actions, [rollouts, steps].

    Returns:
        None if no three numbers follow the actions.
    """
    action, observation = rollouts["action"], rollouts["observation"]
    if action.shape[-1] < AXES:
        return None
    window = _PROBE_WINDOW
    sums = action[..., :AXES].unfold(1, window, 1).sum(-1)[:, :-1]
    change = observation[:, window:] - observation[:, :-window]
    ends = rollouts["next", "done"].squeeze(-1).unfold(1, window, 1)[:, :-1]
    in_episode = ~ends.any(-1)
    sums, change = (x[in_episode].double() for x in (sums, change))
    sums, change = sums - sums.mean(0), change - change.mean(0)
    slopes = (change.T @ sums) / sums.square().sum(0)  # (observed numbers, 3)
    norms = change.norm(dim=0)[:, None] * sums.norm(dim=0)
    correlations = (change.T @ sums) / norms.clamp(min=_SAME**2)
    best = Hand(0, 0.0)
    least = _FOLLOWS
    for column in range(observation.shape[-1] - AXES + 1):
        rows = slice(column, column + AXES)
        if correlations[rows].diagonal().min() > least:
            least = float(correlations[rows].diagonal().min())
            best = Hand(column, float(slopes[rows].diagonal().mean()))
    return best if best.action_scale > 0 else None


def find_layout(env: EnvBase) -> tuple[Hand | None, Geometry]:
    """Find the hand and the geometry of an environment that declares nothing.

    It plays some episodes with random actions.
    """
    rollouts = probe(env)
    hand = find_hand(rollouts)
    return hand, find_geometry(rollouts, None if hand is None else hand.column)


def find_geometry(rollouts: TensorDict, hand: int | None = 0) -> Geometry:
    """Find the geometry of a task that does not declare it, from random actions.

    Three successive numbers of the achieved goal that are equal to three successive
    observed numbers are a position. It is an object's position, unless it is the
    hand's.

    A position that the observation does not contain is left out of the result.

    Args:
        rollouts: Transitions with random actions, [rollouts, steps].
        hand: First column of ``observation`` with the position of the hand. None means
            that it is unknown.
    """
    following = rollouts.reshape(-1).get("next")
    observation, achieved = following["observation"], following["achieved_goal"]
    size, goal_size = observation.shape[-1], achieved.shape[-1]
    columns = _find_columns(observation, achieved)
    pairs: list[tuple[int, int]] = []  # of origin and point
    objects: list[int] = []
    goals: list[int] = []
    for part in split_goal(goal_size):
        column, *others = columns[part]
        if column is None or others != [column + 1, column + 2]:
            continue
        goals.append(part.start)
        if column not in (hand, *objects):
            objects.append(column)
            pairs += [] if hand is None else [(hand, column)]
        pairs.append((column, size + part.start))
    # Points are drawn around the starts of the objects, or of the goals of the hand.
    centres = [rollouts["observation"][:, 0, k : k + 3] for k in objects]
    if not objects:
        centres = [rollouts["desired_goal"][:, 0, k : k + 3] for k in goals]
    box = None
    if centres:
        lowest, highest = torch.cat(centres).aminmax(dim=0)
        margin = lowest.new_tensor(_MARGINS if objects else ((0.0,) * 3,) * 2)
        box = (
            tuple((lowest - margin[0]).tolist()),
            tuple((highest + margin[1]).tolist()),
        )
    return Geometry(
        points=_coordinates(point for _, point in pairs),
        origins=_coordinates(origin for origin, _ in pairs),
        observation=(1.0,) * size,
        goal=(1.0,) * goal_size,
        action=None,  # whether the task is symmetric is unknown
        positions=() if hand is None else (hand, *objects),
        goal_positions=tuple(goals),
        goal_height=None,
        orientation=None,
        box=box,
    )


def _find_columns(observation: Tensor, achieved: Tensor) -> list[int | None]:
    """The column of the observation that equals each number of the achieved goal."""
    differences = (observation.unsqueeze(-1) - achieved.unsqueeze(-2)).abs().amax(0)
    columns: list[int | None] = []
    for difference in differences.T:
        equal = (difference < _SAME).nonzero().flatten().tolist()
        # Constant numbers may have several equal columns. Prefer the next one.
        follows = bool(columns) and columns[-1] is not None
        following = [k for k in equal if follows and k - 1 == columns[-1]]
        columns.append(next(iter(following or equal), None))
    return columns
