"""A robot arm on a fixed base."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from torch_panda.bullet import (
    Control,
    PhysicsClient,
    PositionControl,
    VectorSimulation,
)
from torch_panda.bullet.checks import check_quaternion

# What an action displaces: the end-effector along x, y, z, or the arm's joints.
ControlType = Literal["ee", "joints"]

# An action of 1 moves the end-effector by this [m], or a joint by this [rad].
ACTION_SCALE = 0.05


class Robot:
    """A robot arm on a fixed base, described by a URDF.

    It is usable as it stands for an arm without a gripper; a gripper takes a subclass
    (see `Panda`). One description serves all clients of a simulation.

    Args:
        urdf: a file, or its name among those that pybullet ships.
        neutral_joint_position: where every movable joint starts [rad] or [m].
        joint_forces: the most each movable joint's motor may exert [N m] or [N].
        ee_link: index of the link whose centre of mass is the end-effector.
        ee_orientation: quaternion xyzw that the end-effector keeps, world frame.
        num_arm_joints: how many movable joints, the first ones, are the arm; None
            means all.
        control_type: "ee": an action displaces the end-effector along x, y, z;
            "joints": it displaces the arm's joints.
        base_position: of the base, world frame [m].
        wrist_joint: index of the joint on which the hand is mounted, for the sensor of
            its force and torque; None means that there is none.
        finger_links: indices of the fingers' links, for the sensor of their contacts.
    """

    def __init__(
        self,
        *,
        urdf: str | Path,
        neutral_joint_position: Sequence[float],
        joint_forces: Sequence[float],
        ee_link: int,
        ee_orientation: Sequence[float] = (1.0, 0.0, 0.0, 0.0),
        num_arm_joints: int | None = None,
        control_type: ControlType = "ee",
        base_position: Sequence[float] = (-0.6, 0.0, 0.0),
        wrist_joint: int | None = None,
        finger_links: Sequence[int] = (),
    ) -> None:
        if control_type not in get_args(ControlType):
            raise ValueError(
                f"control_type must be one of {get_args(ControlType)}, "
                f"got {control_type!r}"
            )
        if len(neutral_joint_position) != len(joint_forces):
            raise ValueError(
                f"neutral_joint_position and joint_forces must name the same joints, "
                f"got {len(neutral_joint_position)} and {len(joint_forces)} values"
            )
        check_quaternion("ee_orientation", ee_orientation)
        self.urdf = urdf
        self.neutral_joint_position = tuple(map(float, neutral_joint_position))
        self.joint_forces = tuple(map(float, joint_forces))
        self.ee_link = ee_link
        x, y, z, w = ee_orientation
        self.ee_orientation = (float(x), float(y), float(z), float(w))
        self.num_arm_joints = num_arm_joints or len(self.joint_forces)
        self.control_type: ControlType = control_type
        self.base_position = tuple(map(float, base_position))
        self.wrist_joint = wrist_joint
        self.finger_links = tuple(finger_links)

    @property
    def action_dim(self) -> int:
        """Number of action entries."""
        return 3 if self.control_type == "ee" else self.num_arm_joints

    @property
    def observation_dim(self) -> int:
        """Number of entries of its part of the observation."""
        return 6

    def build(self, client: PhysicsClient) -> int:
        """Load the robot into a client and return its body id.

        Raises:
            FileNotFoundError: the URDF does not exist.
            ValueError: the URDF has another number of movable joints.
        """
        body = client.load_urdf(self.urdf, position=self.base_position, fixed_base=True)
        joints = client.joints(body)
        movable = [joint.name for joint in joints if joint.is_movable]
        if len(movable) != len(self.joint_forces):
            raise ValueError(
                f"{self.urdf} has {len(movable)} movable joints {movable}, but "
                f"joint_forces has {len(self.joint_forces)} values"
            )
        if not 0 <= self.ee_link < len(joints):
            raise ValueError(
                f"ee_link must be a link of {self.urdf}, 0 to {len(joints) - 1}, "
                f"got {self.ee_link}"
            )
        return body

    def setpoint(self, action: Tensor, simulation: VectorSimulation) -> Tensor:
        """What actions ask the motors for, as `control` reads it.

        Args:
            action: (num_envs, action_dim) float32 in [-1, 1].
            simulation: whose robots are to act.

        Returns:
            (num_envs, k), float64: the end-effector's position [m] or the arm's joint
            positions [rad], and behind it where the other joints start, at which they
            stay here [rad] or [m].
        """
        arm = self.arm_setpoint(action, simulation)
        others = arm.new_tensor(self.neutral_joint_position[self.num_arm_joints :])
        return torch.cat((arm, others.expand(len(arm), -1)), dim=1)

    def arm_setpoint(self, action: Tensor, simulation: VectorSimulation) -> Tensor:
        """The part of `setpoint` that is the arm's: (num_envs, 3 or arm joints)."""
        if self.control_type == "ee":
            position = simulation.ee_position + action[:, :3] * ACTION_SCALE
            # The end-effector must not be sent below the table.
            position[:, 2].clamp_(min=0.0)
            return position
        arm = self.num_arm_joints
        return simulation.joint_position[:, :arm] + action[:, :arm] * ACTION_SCALE

    def control(
        self, client: PhysicsClient, body: int, setpoint: npt.NDArray[np.float64]
    ) -> None:
        """Set the motors of one client's robot, in the thread that steps the client.

        A robot that is driven otherwise than by `position_control` overrides this; its
        steps then go through Python.

        Args:
            client: where the robot is ``body``.
            body: its id.
            setpoint: (k,), a row of what `setpoint` gives.
        """
        self.position_control(client, body, setpoint)

    @property
    def position_control(self) -> PositionControl:
        """What `control` does, as data; read once, when an environment is made."""
        if self.control_type == "joints":
            return PositionControl(self.joint_forces)
        return PositionControl(
            self.joint_forces, self.ee_link, self.ee_orientation, self.num_arm_joints
        )

    @property
    def controller(self) -> Control:
        """`control`, as data unless a subclass has its own."""
        has_own = type(self).control is not Robot.control
        return self.control if has_own else self.position_control

    def observation(self, simulation: VectorSimulation) -> Tensor:
        """End-effector position [m] and velocity [m/s]: (num_envs, 6), float64."""
        return torch.cat((simulation.ee_position, simulation.ee_velocity), dim=1)
