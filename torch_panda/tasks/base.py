"""Base class of goal-conditioned tasks."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple, get_args

import numpy as np
import torch
from torch import Tensor

from torch_panda.arguments import Configured
from torch_panda.bullet import PhysicsClient, VectorSimulation
from torch_panda.checks import check_choice, check_not_negative
from torch_panda.rotations import NO_ROTATION

RewardType = Literal["sparse", "dense"]
Quantity = Literal[
    "position",
    "velocity",
    "euler_angles",
    "quaternion",
    "cube_quaternion",
    "angular_velocity",
    "number",
]
"""Physical quantity that consecutive numbers of an observation describe. A "number" is
one number, which does not change if the scene is rotated or mirrored. A quaternion
(xyzw) has 4 numbers; that of a cube says that 24 orientations look the same. The other
quantities have 3 numbers, in the world frame."""
OBJECT_LAYOUT: tuple[Quantity, ...] = (
    "position",
    "euler_angles",
    "velocity",
    "angular_velocity",
)
"""Quantities of `object_observation`."""
RewardFunction = Callable[[Tensor, Tensor], Tensor]
"""A function of achieved and desired goals, both (..., goal_dim), to (..., 1)."""

SAMPLERS = ("sample_goal", "sample_objects", "sample_object_joints")
"""The methods that the default of `Task.sample_start` calls."""

_GOAL_ADVICE = (
    "to start episodes with a goal, call env.reset(TensorDict({'desired_goal': goal}, "
    "env.batch_size), set_state=True)"
)


class Bodies(NamedTuple):
    """Body ids of the bodies that a task has built in a client.

    Attributes:
        objects: Bodies that `Task.sample_objects` places, in the order of
            ``simulation.object_pose``. Their joints are part of the state too. A
            movable body that is not listed starts every episode where `Task.build` put
            it, and states do not hold it.
        markers: Bodies without collisions that show the goal.
    """

    objects: tuple[int, ...] = ()
    markers: tuple[int, ...] = ()


class Start(NamedTuple):
    """Goal and objects at the start of an episode; see `Task.sample_start`.

    Attributes:
        goal: Desired goal, (goal_dim,).
        object_pose: Positions [m] and quaternions xyzw of the objects, world frame,
            (n_objects, 7).
        object_joint_position: Positions of the objects' joints [rad] or [m],
            (n_object_joints,) or, for the same position in all joints, (1,).
    """

    goal: Sequence[float]
    object_pose: Sequence[Sequence[float]] = ()
    object_joint_position: Sequence[float] = (0.0,)


class GoalEntries(NamedTuple):
    """Where an observation holds the achieved goal.

    Attributes:
        part: "task" if `Task.observation` holds it, "robot" if `Robot.observation`
            does, which begins with the end-effector's position.
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
    """A task: scene, goals, observation, success and reward.

    One object describes the task for all environments of a simulation. `build` and
    `randomize` get the client of one environment. The methods whose names start with
    ``sample_`` draw for one episode of one environment, from a random generator of that
    episode. All other methods are batched over the environments. Lengths are in metres,
    and positions are in the world frame.

    A subclass sets ``goal_dim`` and ``observation_dim``. It also sets
    ``max_episode_steps`` if an episode does not have 50 steps. The arguments of the
    shipped tasks are fields of dataclasses, whose defaults are those of the ids that
    end in ``-v1``.

    `torch_panda.testing.check_task` checks all of these methods.

    `randomize`, `reward`, `failure`, `extra_observation` and `info` are optional hooks.
    A hook that a task leaves out is never called, so it costs nothing.

    Once an environment was built, its task refuses assignments that would have no
    effect. Arguments that the class lists in ``changeable`` may change, because they
    are read in every episode or step. A subclass lists only its own arguments there. It
    checks its arguments in `check_arguments`, which also runs at each change. State of
    a subclass, which changes during episodes, needs an attribute of the class, an
    attribute that ``__init__`` or `build` sets, or a name that begins with an
    underscore.

    Args:
        reward_type: "sparse" gives -1 above ``distance_threshold`` and 0 otherwise, or
            0 on success and -1 otherwise if a subclass overrides `is_success`; "dense"
            gives minus the distance to the goal.
        distance_threshold: Distance below which a goal is reached.

    Raises:
        ValueError: An argument is out of range.
    """

    goal_dim: ClassVar[int]
    observation_dim: ClassVar[int]
    max_episode_steps: ClassVar[int] = 50
    goal_entries: ClassVar[GoalEntries | None] = None
    """Where the observation holds the achieved goal; None if it does not.

    `RobotTaskEnv.goal_indices` needs it, and so does the environment's option
    ``goal="observation"``, with which a goal is a full observation. A subclass that
    overrides `observation` or `achieved_goal` must declare it again."""

    observation_layout: ClassVar[tuple[Quantity, ...] | None] = None
    """Quantities of `observation`, in their order; None if they are not declared.

    Relative inputs and data augmentation in training need it and ``goal_entries``.
    The position of each object must precede its other quantities."""
    sampled_goal_height: ClassVar[float | None] = None
    """Height of all sampled goals [m], in a task whose objects come to rest below this
    height, as in Slide. None in all other tasks. In training, relative inputs replace
    the height of achieved goals by this height."""

    reward_type: RewardType = "sparse"
    distance_threshold: float = 0.05

    changeable: ClassVar[tuple[str, ...]] = ("reward_type", "distance_threshold")
    # The environment looks all other methods up in the class of a task.
    _replaceable_methods = frozenset(("sample_start", *SAMPLERS))
    _assignment_advice: ClassVar[Mapping[str, str]] = dict.fromkeys(
        ("goal", "desired_goal"), _GOAL_ADVICE
    )

    def __post_init__(self) -> None:
        self.check_arguments()

    def check_arguments(self) -> None:
        """Check the arguments; see `Configured.check_arguments`."""
        check_choice("reward_type", self.reward_type, get_args(RewardType))
        check_not_negative(distance_threshold=self.distance_threshold)

    @abstractmethod
    def build(self, client: PhysicsClient) -> Bodies:
        """Build the scene in a client.

        Returns:
            The ids of the objects and the markers. The ground, the table and other
            bodies that stay where this method puts them are not among them.
        """

    def sample_start(self, rng: np.random.Generator) -> Start:
        """Draw the goal and the objects of an episode.

        The default calls `sample_goal`, `sample_objects` and `sample_object_joints`, in
        this order. A task overrides `sample_start` instead of these three if one of
        them depends on another, for example if the goal depends on where an object
        starts.

        Args:
            rng: Random generator of the episode.
        """
        return Start(
            self.sample_goal(rng),
            self.sample_objects(rng),
            self.sample_object_joints(rng),
        )

    def sample_goal(self, rng: np.random.Generator) -> Sequence[float]:
        """Draw a desired goal, (goal_dim,)."""
        raise NotImplementedError(
            f"{type(self).__name__} must define sample_goal or sample_start"
        )

    def sample_objects(self, rng: np.random.Generator) -> Sequence[Sequence[float]]:
        """Draw start poses, (n_objects, 7): positions and quaternions xyzw."""
        return ()

    def sample_object_joints(self, rng: np.random.Generator) -> Sequence[float]:
        """Draw start positions of the objects' joints [rad] or [m].

        It has no effect if the objects have no joints.

        Returns:
            Positions in the order of ``simulation.object_joint_position``,
            (n_object_joints,) or, for the same position in all joints, (1,). The
            default is 0.
        """
        return (0.0,)

    def randomize(
        self, client: PhysicsClient, bodies: Bodies, rng: np.random.Generator
    ) -> None:
        """Change the physics of an environment before each of its episodes.

        Optional. It runs in the thread that resets the environment. Its changes may
        depend on ``rng`` only. A change lasts until the next one, so a property that
        the hook sets in one episode must be set in every episode. The hook runs after
        the environment's `Randomization`. If both set the same property, the observed
        ``physics_parameters`` are wrong.

        Args:
            client: Client of the environment; see `PhysicsClient.set_dynamics`.
            bodies: Return value of `build`.
            rng: Random generator for this call alone.
        """

    def reward(
        self,
        simulation: VectorSimulation,
        action: Tensor,
        achieved_goal: Tensor,
        desired_goal: Tensor,
    ) -> Tensor:
        """Reward of a step as a function of state and action.

        Optional. Without it the reward is `compute_reward`. Hindsight relabelling
        always calls `compute_reward`, so the two should be close.

        Args:
            simulation: The environments after the step.
            action: The clipped actions, (num_envs, action_dim) float32 in [-1, 1].
            achieved_goal: Goals after the step, (num_envs, goal_dim) float32.
            desired_goal: Desired goals, (num_envs, goal_dim) float32.

        Returns:
            Rewards, (num_envs, 1).
        """
        return self.compute_reward(achieved_goal, desired_goal)

    def failure(self, simulation: VectorSimulation) -> Tensor:
        """Whether episodes have failed; a failed one ends as ``terminated``. Optional.

        Returns:
            (num_envs, 1) bool.
        """
        return torch.zeros(simulation.num_envs, 1, dtype=torch.bool, device="cpu")

    def extra_observation(self, simulation: VectorSimulation) -> dict[str, Tensor]:
        """Entries to observe in addition to ``observation``. Optional.

        Returns:
            Tensors (num_envs, ...) by key. A float64 tensor is observed as float32.
        """
        return {}

    def info(self, simulation: VectorSimulation) -> dict[str, Tensor]:
        """Numbers to report in addition to the observation, such as costs. Optional.

        torchrl returns them under ``next``, and in the result of a reset. Gymnasium and
        Stable-Baselines3 return them in ``info``. They are never observed.

        Returns:
            Tensors (num_envs, ...) by key, like `extra_observation`.
        """
        return {}

    def marker_pose(self, goal: Tensor) -> Tensor:
        """Poses of the markers that show goals.

        The default takes a goal as one position for each marker.

        Args:
            goal: Desired goals, (..., goal_dim).

        Returns:
            Positions and quaternions xyzw, (..., n_markers, 7).

        Raises:
            ValueError: The default does not apply, because ``goal_dim`` is not a
                multiple of 3.
        """
        if goal.shape[-1] % 3:
            raise ValueError(
                f"{type(self).__name__} needs a marker_pose of its own, because a goal "
                f"of {goal.shape[-1]} numbers is not a position for each marker"
            )
        return _poses(goal)

    def observation(self, simulation: VectorSimulation) -> Tensor:
        """The task's part of the observation, (num_envs, observation_dim) float64.

        The robot's part precedes it in ``observation``. The default is empty.
        """
        return simulation.ee_position[:, :0]

    @abstractmethod
    def achieved_goal(self, simulation: VectorSimulation) -> Tensor:
        """The achieved goals, (num_envs, goal_dim) float64."""

    def objects_at_goal(self, goal: Tensor, objects: ObjectState) -> ObjectState:
        """States of the objects in which goals are reached, for ``goal="observation"``.

        The default takes a goal as one position for each object, and gives the objects
        the orientation `NO_ROTATION`. If the goal is a position of the end-effector,
        the objects stay at their start.

        Args:
            goal: Desired goals, (n, goal_dim) float64.
            objects: The objects at the start of the episodes.

        Returns:
            The objects at rest, with the goals reached.

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
        return objects._replace(pose=_poses(goal))

    def distance(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """Distance between goals, (..., 1). The dense reward is minus this distance."""
        return torch.linalg.vector_norm(
            achieved_goal - desired_goal, dim=-1, keepdim=True
        )

    def success_distance(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """The distance that is compared with ``distance_threshold``, (..., 1)."""
        return self.distance(achieved_goal, desired_goal)

    def is_success(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """Whether goals are reached.

        It is a pure function that needs no simulator and works on any device.

        Args:
            achieved_goal: Achieved goals, (..., goal_dim).
            desired_goal: Desired goals, (..., goal_dim).

        Returns:
            (..., 1) bool.

        Raises:
            ValueError: The last dimension of a goal is not ``goal_dim``.
        """
        self._check_goals(achieved_goal, desired_goal)
        distance = self.success_distance(achieved_goal, desired_goal)
        return distance < self.distance_threshold

    def compute_reward(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """Rewards for achieved goals, a pure function like `is_success`.

        Args:
            achieved_goal: Achieved goals, (..., goal_dim).
            desired_goal: Desired goals, (..., goal_dim).

        Returns:
            (..., 1) float32.

        Raises:
            ValueError: The last dimension of a goal is not ``goal_dim``.
        """
        self._check_goals(achieved_goal, desired_goal)
        if self.reward_type == "dense":
            return -self.distance(achieved_goal, desired_goal).float()
        if type(self).is_success is not Task.is_success:
            return self.is_success(achieved_goal, desired_goal).float() - 1.0
        distance = self.success_distance(achieved_goal, desired_goal)
        return (distance > self.distance_threshold).float().neg()

    def judge(
        self, achieved_goal: Tensor, desired_goal: Tensor
    ) -> tuple[Tensor, Tensor]:
        """`is_success` and `compute_reward` of the same goals, from one distance.

        Environments call it in each step, unless the task overrides `reward`.
        """
        cls = type(self)
        uses_defaults = (
            cls.is_success is Task.is_success
            and cls.compute_reward is Task.compute_reward
            and self.reward_type == "sparse"
        )
        if not uses_defaults:
            success = self.is_success(achieved_goal, desired_goal)
            return success, self.compute_reward(achieved_goal, desired_goal)
        distance = self.success_distance(achieved_goal, desired_goal)
        reward = (distance > self.distance_threshold).float().neg()
        return distance < self.distance_threshold, reward

    def _check_goals(self, achieved_goal: Tensor, desired_goal: Tensor) -> None:
        size = (self.goal_dim,)
        if achieved_goal.shape[-1:] != size or desired_goal.shape[-1:] != size:
            raise ValueError(
                f"achieved_goal and desired_goal must have shape "
                f"(..., {self.goal_dim}), got {tuple(achieved_goal.shape)} and "
                f"{tuple(desired_goal.shape)}"
            )


def _poses(goal: Tensor) -> Tensor:
    """Poses (..., n, 7), not rotated, at the n positions of goals (..., 3 * n)."""
    position = goal.unflatten(-1, (-1, 3))
    rotation = goal.new_tensor(NO_ROTATION).expand(*position.shape[:-1], 4)
    return torch.cat((position, rotation), dim=-1)


def object_observation(simulation: VectorSimulation, index: int) -> Tensor:
    """Position, Euler angles and velocities of an object, (num_envs, 12) float64.

    Args:
        simulation: The environments.
        index: Index of the object among the objects of the task.

    Returns:
        Position [m], roll, pitch and yaw [rad], linear [m/s] and angular velocity
        [rad/s].
    """
    return simulation.object_state.select(1, index)
