"""A robot arm on a fixed base."""

import math
import operator
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Literal, get_args

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from torch_panda.arguments import Configured
from torch_panda.bullet import Control, MotorControl, PhysicsClient, VectorSimulation
from torch_panda.bullet.control import ArmMode
from torch_panda.bullet.urdf import Tool
from torch_panda.checks import (
    check_above_zero,
    check_choice,
    check_finite,
    check_not_negative,
    check_quaternion,
    check_vector,
)
from torch_panda.robots.gripper import Gripper
from torch_panda.rotations import (
    NO_ROTATION,
    inverse,
    quaternion_product,
    rotate,
    rotation_vector_to_quaternion,
)

ControlType = Literal["ee", "ee_pose", "joints", "joint_velocity", "joint_torque"]

# Displacement [m] or [rad], velocity [rad/s], or share of the motor's largest force for
# an action of 1. At 1.25 rad/s a joint moves 0.05 rad in a step of 40 ms.
_ACTION_SCALES: dict[ControlType, float] = {
    "ee": 0.05,
    "ee_pose": 0.05,
    "joints": 0.05,
    "joint_velocity": 1.25,
    "joint_torque": 1.0,
}
_ARM_MODES: dict[ControlType, ArmMode] = {
    "joint_velocity": "velocity",
    "joint_torque": "torque",
}

Workspace = tuple[Sequence[float], Sequence[float]]
"""Lowest and highest (x, y, z) of a box, world frame [m]."""
# A neutral position this far outside a joint's limits [rad] or [m] is a rounding error.
_LIMIT_TOLERANCE = 0.01
ABOVE_THE_TABLE: Workspace = ((-math.inf, -math.inf, 0.0), (math.inf,) * 3)


class Robot(Configured):
    """A robot arm on a fixed base, with or without a gripper, described by a URDF.

    One object describes the robot for all environments of a simulation. An action
    begins with the numbers for the arm, whose meaning depends on the control type. If
    there is a gripper that is not blocked, one more number opens and closes the
    fingers. The robot observes the end-effector's position [m] and velocity [m/s] and,
    with a free gripper, the distance between the fingers [m].

    Args:
        urdf: Path of the URDF, or its name among the files that pybullet ships.
        neutral_joint_position: Start position of each movable joint [rad] or [m], in
            Bullet's order (see `PhysicsClient.joints`).
        effort_limits: Largest torque [N m] or force [N] of each movable joint's motor.
        ee_link: Index of the link whose centre of mass is the end-effector.
        ee_orientation: Orientation that the end-effector keeps under the control type
            "ee": of the link's inertial frame, quaternion xyzw, world frame.
        num_arm_joints: Number of the arm's joints, which are the first movable joints.
            Without a gripper, the joints after them keep their start positions. None
            means all joints except the gripper's.
        control_type: Meaning of an action's numbers for the arm. "ee": displacement of
            the end-effector along x, y and z of the world. "ee_pose": this displacement
            and a rotation vector in the end-effector's frame. "joints": displacement of
            each joint. "joint_velocity": velocity of each joint. "joint_torque": torque
            of each joint, without compensation of gravity.
        action_scale: Displacement [m] or [rad], velocity [rad/s], or share of
            ``effort_limits`` that an action of 1 stands for. None means 0.05 m, 0.05
            rad, 1.25 rad/s, or the whole force.
        gripper: The gripper, which has the last joints; None means no gripper.
        block_gripper: Keep the fingers at their start positions.
        base_position: Position of the base, world frame [m].
        base_orientation: Orientation of the base, quaternion xyzw.
        workspace: Lowest and highest (x, y, z) to which "ee" and "ee_pose" can send the
            end-effector, world frame [m]. The default is the space above the table.
        tool: A link that is added to the URDF, for example as the end-effector.
        wrist_joint: Index of the joint that carries the hand, for the sensor
            "wrist_force_torque"; None means that the robot cannot have this sensor.
        finger_links: Indices of the links of the fingers, for the sensor
            "finger_contact".
        finger_friction: Lateral friction of ``finger_links``; None means the URDF's.

    Once an environment was built, only ``action_scale`` may change.

    Raises:
        ValueError: An argument is out of range, or two arguments contradict each other.
        TypeError: An argument has a wrong type.
    """

    changeable: ClassVar[tuple[str, ...]] = ("action_scale",)

    def __init__(
        self,
        *,
        urdf: str | Path,
        neutral_joint_position: Sequence[float],
        effort_limits: Sequence[float],
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
        finger_friction: float | None = None,
    ) -> None:
        if finger_friction is not None:
            check_not_negative(finger_friction=finger_friction)
        check_choice("control_type", control_type, get_args(ControlType))
        if len(neutral_joint_position) != len(effort_limits):
            raise ValueError(
                f"neutral_joint_position and effort_limits must have the same length, "
                f"got {len(neutral_joint_position)} and {len(effort_limits)} values"
            )
        for position in neutral_joint_position:
            check_finite(neutral_joint_position=position)
        for force in effort_limits:
            check_not_negative(effort_limits=force)
        check_quaternion("ee_orientation", ee_orientation)
        check_quaternion("base_orientation", base_orientation)
        if action_scale is None:
            action_scale = _ACTION_SCALES[control_type]
        self.urdf = urdf
        self.neutral_joint_position = tuple(map(float, neutral_joint_position))
        self.effort_limits = tuple(map(float, effort_limits))
        self.ee_link = operator.index(ee_link)
        x, y, z, w = ee_orientation
        self.ee_orientation = (float(x), float(y), float(z), float(w))
        num_fingers = 0 if gripper is None else gripper.num_joints
        if num_arm_joints is None:
            num_arm_joints = len(effort_limits) - num_fingers
        if not 1 <= num_arm_joints <= len(effort_limits):
            raise ValueError(
                f"num_arm_joints must be from 1 to the number of joints, "
                f"{len(effort_limits)}, got {num_arm_joints}"
            )
        self.num_arm_joints = num_arm_joints
        if gripper is not None and num_arm_joints + num_fingers != len(effort_limits):
            raise ValueError(
                f"a robot with this gripper must have {num_arm_joints} joints of the "
                f"arm and {num_fingers} of the gripper, got {len(effort_limits)} "
                f"effort_limits"
            )
        others = self.neutral_joint_position[num_arm_joints:]
        self._other_joints = torch.tensor(others, dtype=torch.float64, device="cpu")
        self.control_type: ControlType = control_type
        self.action_scale = action_scale
        self.check_arguments()
        self.gripper = gripper
        self.block_gripper = block_gripper
        self.base_position = check_vector("base_position", base_position)
        self.base_orientation = tuple(map(float, base_orientation))
        try:
            box = np.array(workspace, dtype=np.float64)
        except (TypeError, ValueError):  # no numbers, or corners of different sizes
            box = np.empty(0)
        if box.shape != (2, 3) or not (box[0] <= box[1]).all():
            raise ValueError(
                f"workspace must be the lowest and the highest (x, y, z), such as "
                f"((-0.2, -0.2, 0), (0.2, 0.2, 0.4)), got {workspace!r}"
            )
        lowest, highest = box.tolist()
        self.workspace: Workspace = (tuple(lowest), tuple(highest))
        self._lowest, self._highest = torch.from_numpy(box)
        self.tool = tool
        self.wrist_joint = wrist_joint
        self.finger_links = tuple(finger_links)
        self.finger_friction = finger_friction

    def check_arguments(self) -> None:
        """Check the argument that may change; see `Configured.check_arguments`."""
        check_above_zero(action_scale=self.action_scale)

    @property
    def action_dim(self) -> int:
        """Size of an action."""
        arm = {"ee": 3, "ee_pose": 6}.get(self.control_type, self.num_arm_joints)
        return arm + self.has_free_gripper

    @property
    def observation_dim(self) -> int:
        """Size of the robot's part of the observation."""
        return 6 + self.has_free_gripper

    @property
    def has_free_gripper(self) -> bool:
        """Whether the last number of an action moves the fingers."""
        return self.gripper is not None and not self.block_gripper

    def build(self, client: PhysicsClient) -> int:
        """Load the robot into a client, set its friction, and return its body id.

        Raises:
            FileNotFoundError: The URDF does not exist.
            ValueError: The number of movable joints in the URDF is not that of
                ``effort_limits``, a neutral position is outside the limits of its
                joint, or the URDF has no link or joint with a given index.
        """
        body = client.load_urdf(
            self.urdf,
            position=self.base_position,
            orientation=self.base_orientation,
            fixed_base=True,
            tool=self.tool,
        )
        joints = client.joints(body)
        movable = [joint for joint in joints if joint.is_movable]
        if len(movable) != len(self.effort_limits):
            raise ValueError(
                f"{self.urdf} has {len(movable)} movable joints "
                f"{[joint.name for joint in movable]}, but effort_limits has "
                f"{len(self.effort_limits)} values"
            )
        for joint, position in zip(movable, self.neutral_joint_position, strict=True):
            low, high = joint.lower_limit, joint.upper_limit
            is_inside = low - _LIMIT_TOLERANCE <= position <= high + _LIMIT_TOLERANCE
            if low <= high and not is_inside:
                raise ValueError(
                    f"neutral_joint_position of {joint.name} must be between its "
                    f"limits in {self.urdf}, {low:g} and {high:g}, got {position:g}; "
                    f"angles are in radians"
                )
        wrist = () if self.wrist_joint is None else (self.wrist_joint,)
        for name, indices in (
            ("ee_link", (self.ee_link,)),
            ("wrist_joint", wrist),
            ("finger_links", self.finger_links),
        ):
            for index in indices:
                if not 0 <= index < len(joints):
                    part = "joint" if name == "wrist_joint" else "link"
                    raise ValueError(
                        f"{name} must be a {part} of {self.urdf}, 0 to "
                        f"{len(joints) - 1}, got {index}"
                    )
        if self.finger_friction is not None:
            for link in self.finger_links:
                client.set_friction(body, link, lateral=self.finger_friction)
        return body

    def setpoint(self, action: Tensor, simulation: VectorSimulation) -> Tensor:
        """Setpoints of the motors for actions.

        Args:
            action: Clipped actions, (num_envs, action_dim) float32 in [-1, 1].
            simulation: The environments.

        Returns:
            (num_envs, k) float64: the values of `arm_setpoint`, but with the position
            of the URDF's frame of ``ee_link`` instead of the end-effector's, and then
            the positions of the other joints [rad] or [m].
        """
        if self.gripper is None or self.block_gripper:
            arm = self.arm_setpoint(action, simulation)
            others = self._other_joints.expand(len(arm), -1)
        else:
            arm = self.arm_setpoint(action[:, :-1], simulation)
            fingers = simulation.joint_position[:, self.num_arm_joints :]
            others = self.gripper.setpoint(action[:, -1:], fingers)
        if self.control_type in ("ee", "ee_pose"):
            arm = self._link_target(arm, simulation.ee_frame)
        return torch.cat((arm, others), dim=1)

    def arm_setpoint(self, action: Tensor, simulation: VectorSimulation) -> Tensor:
        """Setpoints of the arm for its part of actions.

        Args:
            action: Clipped actions without the gripper's number, (num_envs, j) float32.
            simulation: The environments.

        Returns:
            For "ee" the position of the end-effector [m], (num_envs, 3). For "ee_pose"
            its position and quaternion xyzw, (num_envs, 7). Otherwise the positions
            [rad], velocities [rad/s] or torques [N m] of the arm's joints, (num_envs,
            num_arm_joints).
        """
        scaled = action * self.action_scale
        match self.control_type:
            case "joint_velocity":
                return scaled.double()
            case "joint_torque":
                forces = simulation.joint_position.new_tensor(self.effort_limits)
                return scaled * forces[: self.num_arm_joints]
            case "joints":
                return simulation.joint_position[:, : self.num_arm_joints] + scaled
            case "ee":
                return self._move_ee(scaled, simulation)
        position = self._move_ee(scaled[:, :3], simulation)
        rotation = rotation_vector_to_quaternion(scaled[:, 3:].double())
        orientation = quaternion_product(simulation.ee_orientation, rotation)
        return torch.cat((position, orientation), dim=1)

    def _move_ee(self, offset: Tensor, simulation: VectorSimulation) -> Tensor:
        """Positions of the end-effector at an offset [m], within the workspace."""
        position = simulation.ee_position + offset
        return position.clamp(self._lowest, self._highest)

    def _link_target(self, target: Tensor, ee_frame: Sequence[float]) -> Tensor:
        """Targets of the inverse kinematics for targets of the end-effector.

        The inverse kinematics bring the origin of the URDF's frame of ``ee_link`` to a
        position, and its inertial frame to an orientation. The end-effector is the
        inertial frame.

        Args:
            target: Return value of `arm_setpoint`, (num_envs, 3) or (num_envs, 7).
            ee_frame: See `VectorSimulation`.
        """
        if not any(ee_frame[:3]):  # as in the Panda
            return target
        centre, rotation = target.new_tensor(ee_frame).split((3, 4))
        position, orientation = target[:, :3], target[:, 3:]
        if self.control_type == "ee":
            orientation = target.new_tensor(self.ee_orientation)
            orientation = orientation / torch.linalg.vector_norm(orientation)
        link_orientation = quaternion_product(orientation, inverse(rotation))
        offset = rotate(link_orientation, centre)
        return torch.cat((position - offset, target[:, 3:]), dim=1)

    def control(
        self, client: PhysicsClient, body: int, setpoint: npt.NDArray[np.float64]
    ) -> None:
        """Set the motors of the robot in one client.

        A subclass overrides this method for a control that `MotorControl` cannot
        express. Python threads then step the clients, and each calls the method for the
        client that it steps.

        Args:
            client: The client.
            body: Body id of the robot.
            setpoint: A row of the return value of `setpoint`, (k,).
        """
        self.motor_control(client, body, setpoint)

    @property
    def motor_control(self) -> MotorControl:
        """Description of `control` for the compiled loop.

        An environment reads it once, when it is made.
        """
        arm, forces = self.num_arm_joints, self.effort_limits
        if self.control_type == "ee":
            return MotorControl(forces, self.ee_link, self.ee_orientation, arm)
        if self.control_type == "ee_pose":
            return MotorControl(forces, self.ee_link, num_arm_joints=arm)
        mode = _ARM_MODES.get(self.control_type, "position")
        return MotorControl(forces, num_arm_joints=arm, arm_mode=mode)

    @property
    def controller(self) -> Control:
        """`control` if a subclass overrides it, otherwise `motor_control`."""
        overrides = type(self).control is not Robot.control
        return self.control if overrides else self.motor_control

    def observation(self, simulation: VectorSimulation) -> Tensor:
        """Position and velocity of the end-effector, and the fingers' distance.

        Returns:
            (num_envs, 6) float64, or (num_envs, 7) with a free gripper.
        """
        if not self.has_free_gripper:
            return simulation.ee_state
        return torch.cat((simulation.ee_state, self.fingers_width(simulation)), dim=1)

    def fingers_width(self, simulation: VectorSimulation) -> Tensor:
        """Distance between the fingers [m], (num_envs, 1) float64.

        Raises:
            ValueError: The robot has no gripper.
        """
        if self.gripper is None:
            raise ValueError(f"{type(self).__name__} has no gripper")
        joints = simulation.joint_position[:, self.num_arm_joints :]
        return self.gripper.fingers_width(joints)
