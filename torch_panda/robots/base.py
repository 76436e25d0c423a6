"""A robot arm on a fixed base."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from torch_panda.arguments import Configured
from torch_panda.bullet import (
    Control,
    MotorControl,
    PhysicsClient,
    VectorSimulation,
)
from torch_panda.bullet.urdf import Tool
from torch_panda.checks import check_quaternion
from torch_panda.robots.control_type import ACTION_SCALES, ARM_MODES, ControlType
from torch_panda.robots.gripper import Gripper
from torch_panda.rotations import (
    NO_ROTATION,
    quaternion_product,
    rotation_vector_to_quaternion,
)

# Lowest and highest x, y, z, world frame [m].
Workspace = tuple[Sequence[float], Sequence[float]]
_FAR = math.inf
ABOVE_THE_TABLE: Workspace = ((-_FAR, -_FAR, 0.0), (_FAR, _FAR, _FAR))


class Robot(Configured):
    """A robot arm on a fixed base, described by a URDF, with or without a gripper.

    One description serves all clients of a simulation. An action has the arm's numbers,
    and a last one of the gripper's, if there is one that is not blocked: by how much
    the fingers open. Observations are the end-effector's position [m] and velocity
    [m/s], and then the distance between the fingers [m].

    Args:
        urdf: a file, or its name among those that pybullet ships.
        neutral_joint_position: where every movable joint starts [rad] or [m].
        joint_forces: the most each movable joint's motor may exert [N m] or [N].
        ee_link: index of the link whose centre of mass is the end-effector.
        ee_orientation: quaternion xyzw that the end-effector keeps under the control
            type "ee", world frame.
        num_arm_joints: how many movable joints, the first ones, are the arm; None
            means all but the gripper's. Further joints stay where they start.
        control_type: what an action does: "ee" displaces the end-effector along x, y, z
            of the world; "ee_pose" also turns it, by a rotation vector in its own
            frame; "joints" displaces the arm's joints, "joint_velocity" is their
            velocity and "joint_torque" their motors' torque, without compensation of
            gravity.
        action_scale: what an action of 1 is: 0.05 m or rad, 1.25 rad/s, or this part of
            ``joint_forces``, all of it; None means these.
        gripper: of the last joints; None: there is none.
        block_gripper: keep the fingers where they start.
        base_position: of the base, world frame [m].
        base_orientation: of the base, quaternion xyzw.
        workspace: the box in which actions send the end-effector, lowest and highest
            (x, y, z), world frame [m]; by default all above the table.
        tool: a link that the URDF lacks, which can be the end-effector.
        wrist_joint: index of the joint on which the hand is mounted, for the sensor of
            its force and torque; None means that there is none.
        finger_links: indices of the fingers' links, for the sensor of their contacts.

    Raises:
        ValueError: an argument is out of range, or two do not fit together.
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
        action_scale: float | None = None,
        gripper: Gripper | None = None,
        block_gripper: bool = False,
        base_position: Sequence[float] = (-0.6, 0.0, 0.0),
        base_orientation: Sequence[float] = NO_ROTATION,
        workspace: Workspace = ABOVE_THE_TABLE,
        tool: Tool | None = None,
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
        if not np.isfinite(neutral_joint_position).all():
            raise ValueError(
                f"neutral_joint_position must be finite, got {neutral_joint_position}"
            )
        if len(base_position) != 3 or not np.isfinite(base_position).all():
            raise ValueError(
                f"base_position must be three finite numbers, got {base_position}"
            )
        check_quaternion("ee_orientation", ee_orientation)
        check_quaternion("base_orientation", base_orientation)
        if action_scale is None:
            action_scale = ACTION_SCALES[control_type]
        if not 0 < action_scale < math.inf:
            raise ValueError(f"action_scale must be above 0, got {action_scale}")
        self.urdf = urdf
        self.neutral_joint_position = tuple(map(float, neutral_joint_position))
        self.joint_forces = tuple(map(float, joint_forces))
        self.ee_link = ee_link
        x, y, z, w = ee_orientation
        self.ee_orientation = (float(x), float(y), float(z), float(w))
        num_fingers = 0 if gripper is None else gripper.num_joints
        if num_arm_joints is None:
            num_arm_joints = len(joint_forces) - num_fingers
        if not 1 <= num_arm_joints <= len(joint_forces):
            raise ValueError(
                f"num_arm_joints must be from 1 to the number of joints, "
                f"{len(joint_forces)}, got {num_arm_joints}"
            )
        self.num_arm_joints = num_arm_joints
        if gripper is not None and self.num_arm_joints + num_fingers != len(
            joint_forces
        ):
            raise ValueError(
                f"a robot with a gripper must have {self.num_arm_joints} joints of the "
                f"arm and {num_fingers} of the gripper, got {len(joint_forces)} in all"
            )
        rest = self.neutral_joint_position[self.num_arm_joints :]
        self._rest = torch.tensor(rest, dtype=torch.float64, device="cpu")
        self.control_type: ControlType = control_type
        self.action_scale = action_scale
        self.gripper = gripper
        self.block_gripper = block_gripper
        self.base_position = tuple(map(float, base_position))
        self.base_orientation = tuple(map(float, base_orientation))
        box = np.asarray(workspace, dtype=np.float64)
        if box.shape != (2, 3) or not (box[0] <= box[1]).all():
            raise ValueError(
                f"workspace must be the lowest and the highest (x, y, z), got "
                f"{workspace!r}"
            )
        self.workspace: Workspace = workspace
        self._lowest, self._highest = torch.from_numpy(box)
        self.tool = tool
        self.wrist_joint = wrist_joint
        self.finger_links = tuple(finger_links)

    @property
    def action_dim(self) -> int:
        """Number of action entries."""
        return self._arm_action_dim + self.has_free_gripper

    @property
    def observation_dim(self) -> int:
        """Number of entries of its part of the observation."""
        return 6 + self.has_free_gripper

    @property
    def _arm_action_dim(self) -> int:
        return {"ee": 3, "ee_pose": 6}.get(self.control_type, self.num_arm_joints)

    @property
    def has_free_gripper(self) -> bool:
        """Whether the last action entry moves the fingers."""
        return self.gripper is not None and not self.block_gripper

    def build(self, client: PhysicsClient) -> int:
        """Load the robot into a client and return its body id.

        Raises:
            FileNotFoundError: the URDF does not exist.
            ValueError: the URDF has another number of movable joints, or lacks a link
                or joint.
        """
        body = client.load_urdf(
            self.urdf,
            position=self.base_position,
            orientation=self.base_orientation,
            fixed_base=True,
            tool=self.tool,
        )
        joints = client.joints(body)
        movable = [joint.name for joint in joints if joint.is_movable]
        if len(movable) != len(self.joint_forces):
            raise ValueError(
                f"{self.urdf} has {len(movable)} movable joints {movable}, but "
                f"joint_forces has {len(self.joint_forces)} values"
            )
        wrist = () if self.wrist_joint is None else (self.wrist_joint,)
        for name, indices in (
            ("ee_link", (self.ee_link,)),
            ("wrist_joint", wrist),
            ("finger_links", self.finger_links),
        ):
            for index in indices:
                if not 0 <= index < len(joints):
                    kind = "joint" if name == "wrist_joint" else "link"
                    raise ValueError(
                        f"{name} must be a {kind} of {self.urdf}, 0 to "
                        f"{len(joints) - 1}, got {index}"
                    )
        return body

    def setpoint(self, action: Tensor, simulation: VectorSimulation) -> Tensor:
        """What actions ask the motors for, as `control` reads it.

        Args:
            action: (num_envs, action_dim) float32 in [-1, 1].
            simulation: whose robots are to act.

        Returns:
            (num_envs, k), float64: the arm's part, as `arm_setpoint`, and behind it the
            positions of the other joints [rad] or [m].
        """
        if self.gripper is None or self.block_gripper:
            arm = self.arm_setpoint(action, simulation)
            others = self._rest.expand(len(arm), -1)
        else:
            arm = self.arm_setpoint(action[:, :-1], simulation)
            fingers = simulation.joint_position[:, self.num_arm_joints :]
            others = self.gripper.setpoint(action[:, -1:], fingers)
        return torch.cat((arm, others), dim=1)

    def arm_setpoint(self, action: Tensor, simulation: VectorSimulation) -> Tensor:
        """The part of `setpoint` that is the arm's, by the control type.

        Args:
            action: (num_envs, k) float32 in [-1, 1], without the gripper's.
            simulation: whose robots are to act.

        Returns:
            "ee": (num_envs, 3), position [m]; "ee_pose": (num_envs, 7), position and
            quaternion xyzw; else (num_envs, arm joints): positions [rad], velocities
            [rad/s] or torques [N m].
        """
        displacement = action * self.action_scale
        match self.control_type:
            case "joint_velocity":
                return displacement.double()
            case "joint_torque":
                forces = simulation.joint_position.new_tensor(self.joint_forces)
                return displacement * forces[: self.num_arm_joints]
            case "joints":
                return (
                    simulation.joint_position[:, : self.num_arm_joints] + displacement
                )
        shift = displacement if self.control_type == "ee" else displacement[:, :3]
        # The end-effector must not be sent below the table.
        position = (simulation.ee_position + shift).clamp(self._lowest, self._highest)
        if self.control_type == "ee":
            return position
        turn = rotation_vector_to_quaternion(displacement[:, 3:].double())
        orientation = quaternion_product(simulation.ee_orientation, turn)
        return torch.cat((position, orientation), dim=1)

    def control(
        self, client: PhysicsClient, body: int, setpoint: npt.NDArray[np.float64]
    ) -> None:
        """Set the motors of one client's robot, in the thread that steps the client.

        A robot that is driven otherwise than by `motor_control` overrides this; its
        steps then go through Python.

        Args:
            client: where the robot is ``body``.
            body: its id.
            setpoint: (k,), a row of what `setpoint` gives.
        """
        self.motor_control(client, body, setpoint)

    @property
    def motor_control(self) -> MotorControl:
        """What `control` does, as data; read once, when an environment is made."""
        arm, forces = self.num_arm_joints, self.joint_forces
        if self.control_type == "ee":
            return MotorControl(forces, self.ee_link, self.ee_orientation, arm)
        if self.control_type == "ee_pose":
            return MotorControl(forces, self.ee_link, num_arm_joints=arm)
        mode = ARM_MODES.get(self.control_type, "position")
        return MotorControl(forces, num_arm_joints=arm, arm_mode=mode)

    @property
    def controller(self) -> Control:
        """`control`, as data unless a subclass has its own."""
        has_own = type(self).control is not Robot.control
        return self.control if has_own else self.motor_control

    def observation(self, simulation: VectorSimulation) -> Tensor:
        """Position, velocity and fingers' width: (num_envs, 6 or 7), float64."""
        if not self.has_free_gripper:
            return simulation.ee_state
        return torch.cat((simulation.ee_state, self.fingers_width(simulation)), dim=1)

    def fingers_width(self, simulation: VectorSimulation) -> Tensor:
        """Distance between the fingers [m]: (num_envs, 1), float64.

        Raises:
            ValueError: there is no gripper.
        """
        if self.gripper is None:
            raise ValueError(f"{type(self).__name__} has no gripper")
        joints = simulation.joint_position[:, self.num_arm_joints :]
        return self.gripper.fingers_width(joints)
