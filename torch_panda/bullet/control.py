"""Control of a robot's motors by a Python function or by a `MotorControl`."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from torch_panda.bullet.body_state import Doubles
from torch_panda.bullet.client import PhysicsClient

# A function that sets the motors of one client's robot, in the thread that steps the
# client. Its arguments are the client, the robot's body id and a row of setpoints.
Control = Callable[[PhysicsClient, int, Doubles], None]

# Meaning of the setpoints of the arm's joints.
ArmMode = Literal["position", "velocity", "torque"]


@dataclass(frozen=True)
class MotorControl:
    """Drives all movable joints of a robot to setpoints.

    It is a `Control` that C threads carry out; see `Loop`. The arm's joints are the
    first joints of the robot.

    A setpoint is a row of numbers. Its first part is for the arm. Without ``ik_link``,
    it has one number per joint of the arm: positions [rad], velocities [rad/s] or
    torques [N m], depending on ``arm_mode``. With ``ik_link``, it is the target
    position of that link and, unless ``ik_orientation`` fixes it, its orientation; see
    `PhysicsClient.inverse_kinematics`. The second part has the positions of all other
    joints [rad] or [m].

    Attributes:
        forces: Maximum force of every joint's motor [N m] or [N]. The torques of
            ``arm_mode="torque"`` are not limited.
        ik_link: Link that the inverse kinematics bring to its target. It requires
            ``arm_mode="position"``, and a ``num_arm_joints`` above 0. None means that
            setpoints contain the arm's joints.
        ik_orientation: Orientation that this link keeps, quaternion xyzw in the world
            frame; None means that setpoints contain it.
        num_arm_joints: Number of the arm's joints.
        arm_mode: Meaning of the setpoints of the arm's joints.
    """

    forces: tuple[float, ...]
    ik_link: int | None = None
    ik_orientation: tuple[float, float, float, float] | None = None
    num_arm_joints: int = 0
    arm_mode: ArmMode = "position"

    @property
    def setpoint_dim(self) -> int:
        """Size of a setpoint."""
        if self.ik_link is None:
            return len(self.forces)
        return self._pose_dim + len(self.forces) - self.num_arm_joints

    @property
    def _pose_dim(self) -> int:
        return 7 if self.ik_orientation is None else 3

    def check(self, num_joints: int) -> None:
        """Make sure that this control fits a robot with this number of joints.

        Raises:
            ValueError: The number of forces is wrong, ``num_arm_joints`` or ``ik_link``
                is out of range, or ``ik_link`` is used with velocities, with torques or
                without an arm.
        """
        if self.ik_link is not None and self.arm_mode != "position":
            raise ValueError(
                f'ik_link needs arm_mode "position", got "{self.arm_mode}"'
            )
        if self.ik_link is not None and self.num_arm_joints == 0:
            raise ValueError(
                "ik_link needs num_arm_joints, the number of joints that the inverse "
                "kinematics may move"
            )
        if len(self.forces) != num_joints:
            raise ValueError(
                f"a MotorControl needs a force for each of {num_joints} movable "
                f"joints, got {len(self.forces)}"
            )
        if not 0 <= self.num_arm_joints <= num_joints:
            raise ValueError(
                f"num_arm_joints must be from 0 to {num_joints}, the number of movable "
                f"joints, got {self.num_arm_joints}"
            )
        if self.ik_link is not None and self.ik_link < 0:
            raise ValueError(f"ik_link must be None or at least 0, got {self.ik_link}")

    def __call__(self, client: PhysicsClient, body: int, setpoint: Doubles) -> None:
        """Set the motors of one client's robot, for a control written in Python.

        Raises:
            ValueError: Setpoints are torques. Bullet applies a torque in one substep
                only, and this function is called once per step.
        """
        if self.arm_mode == "torque":
            raise ValueError(
                'a control written in Python cannot use arm_mode "torque": Bullet '
                "applies a torque in one substep only"
            )
        joints = setpoint
        if self.ik_link is not None:
            pose = setpoint[: self._pose_dim]
            joints = np.empty(len(self.forces))
            orientation = self.ik_orientation or pose[3:].tolist()
            client.inverse_kinematics(body, self.ik_link, pose[:3], orientation, joints)
            joints[self.num_arm_joints :] = setpoint[self._pose_dim :]
        # The first joint that is driven to a position.
        first = 0 if self.arm_mode == "position" else self.num_arm_joints
        client.control_joints(body, joints[first:], self.forces, joints[:first])
