"""A goal-conditioned task."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple, get_args

import numpy as np
import torch
from torch import Tensor

from torch_panda.arguments import Configured
from torch_panda.bullet import PhysicsClient, VectorSimulation
from torch_panda.checks import check_not_negative
from torch_panda.rotations import NO_ROTATION
from torch_panda.tasks.table import create_table

# What tasks of users are made of is found here.
__all__ = [
    "NO_ROTATION",
    "Bodies",
    "GoalEntries",
    "ObjectState",
    "Start",
    "Task",
    "create_table",
    "object_observation",
]

RewardType = Literal["sparse", "dense"]
# (achieved_goal, desired_goal), both (..., goal_dim), to (..., 1).
RewardFunction = Callable[[Tensor, Tensor], Tensor]


class Bodies(NamedTuple):
    """What a task has built in a client, by body id.

    Attributes:
        objects: movable objects, in the order in which observations name them. Their
            joints, if they have any, are part of the state, too.
        markers: bodies that nothing touches, which show the goal.
    """

    objects: tuple[int, ...] = ()
    markers: tuple[int, ...] = ()


class Start(NamedTuple):
    """What a task draws for an episode; see `Task.sample_start`.

    Attributes:
        goal: (goal_dim,).
        object_pose: (n_objects, 7), positions [m] and quaternions xyzw, world frame.
        object_joint_position: (n_object_joints,) [rad] or [m]; or one number for all.
    """

    goal: Sequence[float]
    object_pose: Sequence[Sequence[float]] = ()
    object_joint_position: Sequence[float] = (0.0,)


class GoalEntries(NamedTuple):
    """Where an observation holds the achieved goal.

    Attributes:
        part: "task" for entries of `Task.observation`, "robot" for entries of
            `Robot.observation`, which begins with the end-effector's position.
        indices: Indices in this part, in the order of the goal, (goal_dim,).
    """

    part: Literal["robot", "task"]
    indices: tuple[int, ...]


class ObjectState(NamedTuple):
    """Poses and joint positions of the objects of n environments.

    Attributes:
        pose: Positions [m] and quaternions xyzw, world frame, (n, n_objects, 7).
        joint_position: (n, n_object_joints) [rad] or [m].
    """

    pose: Tensor
    joint_position: Tensor


@dataclass(kw_only=True, eq=False, repr=False)
class Task(Configured, ABC):
    """What is to be done: scene, goals, observation, success, reward.

    One description serves all clients of a simulation. Sampling is done for one
    episode of one environment with its own random generator; all else is batched over
    the state tensors of the simulation. Lengths are in metres, in the world frame.

    A task sets ``goal_dim``, ``observation_dim`` and, unless it is 50,
    ``max_episode_steps``. The defaults of its arguments are those of the ids -v1.

    `randomize`, `reward`, `failure` and `extra_observation` are hooks: a task has those
    that it overrides, and the others are never called.

    Args:
        reward_type: "sparse": 0 on success and -1 otherwise; "dense": -distance.
        distance_threshold: success is a distance below it.

    Raises:
        ValueError: one is none of these.
    """

    goal_dim: ClassVar[int]
    observation_dim: ClassVar[int]
    max_episode_steps: ClassVar[int] = 50
    goal_entries: ClassVar[GoalEntries | None] = None
    """Where the observation holds the achieved goal; None if it does not.

    `RobotTaskEnv.goal_indices` and ``goal="observation"`` need it. A subclass that
    overrides `observation` or `achieved_goal` declares it anew."""

    reward_type: RewardType = "sparse"
    distance_threshold: float = 0.05

    def __post_init__(self) -> None:
        if self.reward_type not in get_args(RewardType):
            raise ValueError(
                f"reward_type must be one of {get_args(RewardType)}, "
                f"got {self.reward_type!r}"
            )
        check_not_negative(distance_threshold=self.distance_threshold)

    @abstractmethod
    def build(self, client: PhysicsClient) -> Bodies:
        """Build the scene in a client."""

    def sample_start(self, rng: np.random.Generator) -> Start:
        """Draw what an episode starts with.

        By default what the next three draw, in this order, each on its own. A task in
        which one depends on another, such as a goal on where an object starts,
        overrides this instead.
        """
        return Start(
            self.sample_goal(rng),
            self.sample_objects(rng),
            self.sample_object_joints(rng),
        )

    def sample_goal(self, rng: np.random.Generator) -> Sequence[float]:
        """Draw a goal: (goal_dim,)."""
        name = type(self).__name__
        raise NotImplementedError(f"{name} must have a sample_goal or a sample_start")

    def sample_objects(self, rng: np.random.Generator) -> Sequence[Sequence[float]]:
        """Draw start poses: (n_objects, 7), position and quaternion xyzw."""
        return ()

    def sample_object_joints(self, rng: np.random.Generator) -> Sequence[float]:
        """Draw start positions of the objects' joints [rad] or [m], by default 0.

        Unused if they have none.

        Returns:
            (n_object_joints,), as `VectorSimulation.object_joint_position`; or one
            number for all.
        """
        return (0.0,)

    def randomize(
        self, client: PhysicsClient, bodies: Bodies, rng: np.random.Generator
    ) -> None:
        """Change the physics of an environment before each of its episodes.

        A hook, which runs in the thread that resets the environment. What it changes
        must depend on ``rng`` alone, and whatever it changes once it must set every
        time: what the last episode had is still there.

        Args:
            client: of the environment; see `PhysicsClient.set_dynamics`.
            bodies: what `build` has built.
            rng: of this episode, and of nothing else.
        """

    def reward(
        self,
        simulation: VectorSimulation,
        action: Tensor,
        achieved_goal: Tensor,
        desired_goal: Tensor,
    ) -> Tensor:
        """The reward of a step, which may depend on state and action.

        A hook. By default it is `compute_reward`, which remains the function of goals
        that hindsight relabelling calls.

        Args:
            simulation: the state after the step.
            action: (num_envs, action_dim) float32 in [-1, 1].
            achieved_goal: (num_envs, goal_dim) float32, after the step.
            desired_goal: (num_envs, goal_dim) float32.

        Returns:
            (num_envs, 1).
        """
        return self.compute_reward(achieved_goal, desired_goal)

    def failure(self, simulation: VectorSimulation) -> Tensor:
        """Where an episode has failed, and ends as ``terminated``.

        A hook. By default none fails.

        Returns:
            (num_envs, 1), bool.
        """
        return torch.zeros(simulation.num_envs, 1, dtype=torch.bool, device="cpu")

    def extra_observation(self, simulation: VectorSimulation) -> dict[str, Tensor]:
        """What is observed beside ``observation``, each under a key of its own.

        A hook. By default nothing is.

        Returns:
            By key (num_envs, ...); float64 is observed as float32.
        """
        return {}

    def marker_pose(self, goal: Tensor) -> Tensor:
        """Where goals put the markers: (..., goal_dim) -> (..., n_markers, 7).

        By default a goal is one position for each marker. Unused without markers.

        Raises:
            ValueError: by default: a goal is not made of positions.
        """
        if goal.shape[-1] % 3:
            raise ValueError(
                f"{type(self).__name__} needs a marker_pose of its own: its goals of "
                f"{goal.shape[-1]} numbers are no positions for markers"
            )
        positions = goal.unflatten(-1, (-1, 3))
        rotation = goal.new_tensor(NO_ROTATION).expand(*positions.shape[:-1], 4)
        return torch.cat((positions, rotation), dim=-1)

    def observation(self, simulation: VectorSimulation) -> Tensor:
        """The task's part of the observation: (num_envs, observation_dim), float64."""
        return simulation.ee_position[:, :0]

    @abstractmethod
    def achieved_goal(self, simulation: VectorSimulation) -> Tensor:
        """What has been achieved: (num_envs, goal_dim), float64."""

    def objects_at_goal(self, goal: Tensor, objects: ObjectState) -> ObjectState:
        """Where the objects are when goals are reached, for ``goal="observation"``.

        By default a goal is one position for each object, which is not rotated. Where
        the goal is a position of the end-effector, the objects stay where they start.

        Args:
            goal: Desired goals, (n, goal_dim) float64.
            objects: The objects at the start of the episodes.

        Returns:
            The objects at rest, after the task was done.

        Raises:
            NotImplementedError: The default does not apply to this task.
        """
        if self.goal_entries is not None and self.goal_entries.part == "robot":
            return objects
        if goal.shape[1] != 3 * objects.pose.shape[1]:
            raise NotImplementedError(
                f'goal="observation" needs {type(self).__name__}.objects_at_goal: its '
                f"goals are not one position for each object"
            )
        position = goal.unflatten(1, (-1, 3))
        rotation = goal.new_tensor(NO_ROTATION).expand(*position.shape[:-1], 4)
        pose = torch.cat((position, rotation), dim=-1)
        return objects._replace(pose=pose)

    def distance(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """How far the goal is, (..., 1); minus this is the dense reward."""
        return torch.linalg.vector_norm(
            achieved_goal - desired_goal, dim=-1, keepdim=True
        )

    def success_distance(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """What is compared with ``distance_threshold``, (..., 1)."""
        return self.distance(achieved_goal, desired_goal)

    def is_success(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """Whether the goal is reached.

        A pure function on any device, without a simulator.

        Args:
            achieved_goal: (..., goal_dim).
            desired_goal: (..., goal_dim).

        Returns:
            (..., 1), bool.

        Raises:
            ValueError: a last dimension is not ``goal_dim``.
        """
        self._check_goals(achieved_goal, desired_goal)
        distance = self.success_distance(achieved_goal, desired_goal)
        return distance < self.distance_threshold

    def compute_reward(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """The reward for an achieved goal; see `is_success`.

        Returns:
            (..., 1), float32.
        """
        self._check_goals(achieved_goal, desired_goal)
        if self.reward_type == "dense":
            return -self.distance(achieved_goal, desired_goal).float()
        distance = self.success_distance(achieved_goal, desired_goal)
        return (distance > self.distance_threshold).float().neg()

    def _check_goals(self, achieved_goal: Tensor, desired_goal: Tensor) -> None:
        sizes = (self.goal_dim,)
        if achieved_goal.shape[-1:] != sizes or desired_goal.shape[-1:] != sizes:
            shapes = tuple(achieved_goal.shape), tuple(desired_goal.shape)
            raise ValueError(
                f"achieved_goal and desired_goal must have shape "
                f"(..., {self.goal_dim}), got {shapes[0]} and {shapes[1]}"
            )


def object_observation(simulation: VectorSimulation, index: int) -> Tensor:
    """Position, Euler angles [rad] and velocity of an object: (num_envs, 12)."""
    return simulation.object_state.select(1, index)
