"""Sizes and layout of an environment, from which agents build their networks.

They are saved with a policy, so that its file alone is enough to build the networks
again.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torchrl.data import Bounded, TensorSpec
from typing_extensions import Self

from torch_panda.envs import RobotTaskEnv
from torch_panda.learning.environments import GoalEnv
from torch_panda.learning.environments.geometry import (
    AXES,
    Geometry,
    find_geometry,
    find_layout,
    observes_hand_first,
    probe,
    read_geometry,
)
from torch_panda.tasks import Task


@dataclass(frozen=True)
class Spaces:
    """Sizes, layout and rewards of an environment.

    Attributes:
        observation_size: Size of ``observation``.
        goal_size: Size of ``desired_goal``.
        action_size: Size of ``action``.
        num_envs: Number of environments in which the agent explores in parallel.
        max_episode_steps: Number of steps after which an episode is truncated.
        has_free_gripper: Whether the last number of an action moves the fingers.
        has_sparse_reward: Whether every reward is -1 or 0.
        geometry: Layout of observation, goal and action; None if it is unknown.
        action_scale: What an action of 1 means; see `Robot`.
        moves_joints: Whether actions are displacements of joints, and not of the
            end-effector.
    """

    observation_size: int
    goal_size: int
    action_size: int
    num_envs: int
    max_episode_steps: int
    has_free_gripper: bool
    has_sparse_reward: bool
    geometry: Geometry | None
    action_scale: float
    moves_joints: bool

    @property
    def num_arm_actions(self) -> int:
        """Number of entries of an action that move the arm. They come first."""
        return self.action_size - int(self.has_free_gripper)

    @property
    def follows_points(self) -> bool:
        """Whether the exploration "points" fits; see `follows_points`."""
        return follows_points(
            self.num_arm_actions,
            knows_hand=self.geometry is None or bool(self.geometry.positions),
            moves_joints=self.moves_joints,
        )

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Make the object from the nested dict that `asdict` returned."""
        geometry = values["geometry"]
        if geometry is not None:
            geometry = Geometry(**geometry)
        return cls(**{**values, "geometry": geometry})

    def action_spec(self, *batch_size: int) -> TensorSpec:
        """Make the spec of actions on the default device."""
        device = torch.get_default_device()
        shape = torch.Size((*batch_size, self.action_size))
        return Bounded(-1.0, 1.0, shape, device=device)


def follows_points(
    num_arm_actions: int, *, knows_hand: bool, moves_joints: bool
) -> bool:
    """Whether the exploration "points" fits: it moves the hand or the joints.

    Args:
        num_arm_actions: Number of entries of an action that move the arm. Three of them
            displace the hand.
        knows_hand: Whether it is known where the position of the hand is observed.
        moves_joints: Whether actions are displacements of joints.
    """
    return moves_joints or (knows_hand and num_arm_actions == AXES)


def read_spaces(env: GoalEnv, *, finds_layout: bool = False) -> Spaces:
    """Read the sizes and the layout of an environment.

    Args:
        env: The environment.
        finds_layout: Whether to find a layout that the task does not declare, from some
            episodes with random actions; see `find_geometry`.
    """
    if isinstance(env, RobotTaskEnv):
        return _read_robot_spaces(env, finds_layout=finds_layout)
    hand = geometry = None
    if finds_layout:
        hand, geometry = find_layout(env)
    sizes = _read_sizes(env)
    return Spaces(
        **sizes,
        # After the three numbers that move the hand, one more moves the fingers.
        has_free_gripper=hand is not None and sizes["action_size"] == 4,
        has_sparse_reward=getattr(env, "has_sparse_reward", False),
        geometry=geometry,
        action_scale=1.0 if hand is None else hand.action_scale,
        moves_joints=False,
    )


def _read_robot_spaces(env: RobotTaskEnv, *, finds_layout: bool) -> Spaces:
    robot = env.robot
    geometry = read_geometry(env)
    if geometry is None and finds_layout:
        geometry = find_geometry(probe(env), 0 if observes_hand_first(robot) else None)
    return Spaces(
        **_read_sizes(env),
        has_free_gripper=robot.has_free_gripper,
        has_sparse_reward=has_sparse_reward(env.task),
        geometry=geometry,
        action_scale=float(robot.action_scale),
        moves_joints=robot.control_type == "joints",
    )


def _read_sizes(env: GoalEnv) -> dict[str, int]:
    """The sizes among the attributes of `Spaces`."""
    return {
        "observation_size": env.observation_spec["observation"].shape[-1],
        "goal_size": env.observation_spec["desired_goal"].shape[-1],
        "action_size": env.action_spec.shape[-1],
        "num_envs": env.batch_size.numel(),
        "max_episode_steps": env.max_episode_steps,
    }


def has_sparse_reward(task: Task) -> bool:
    """Whether a task has the sparse rewards of `Task`, -1 and 0."""
    cls = type(task)
    overrides = (
        cls.compute_reward is not Task.compute_reward or cls.reward is not Task.reward
    )
    return task.reward_type == "sparse" and not overrides
