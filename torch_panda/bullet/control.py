"""What sets the motors of a robot."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from torch_panda.bullet.body_state import Doubles
from torch_panda.bullet.client import PhysicsClient

# Sets the motors of one client's robot, in the thread that steps the client, given the
# client, the robot's body id and a row of setpoints.
Control = Callable[[PhysicsClient, int, Doubles], None]

# What the setpoints of the arm's joints are.
ArmMode = Literal["position", "velocity", "torque"]


@dataclass(frozen=True)
class MotorControl:
    """Drives all movable joints of a robot.

    It is a `Control`, and as data one that the native loop carries out without Python.
    A setpoint holds what all joints are driven to: the arm's, the first ones, to
    positions [rad], velocities [rad/s] or by torques [N m], the others to positions
    [rad] or [m]. With an ``ik_link`` it holds instead of the arm's where the centre of
    mass of that link is to be, world frame [m], and without an ``ik_orientation`` its
    orientation, a quaternion xyzw, too.

    Attributes:
        forces: the most each joint's motor may exert [N m] or [N]; torques are not
            limited.
        ik_link: the link for which inverse kinematics find the arm's joint positions;
            None: setpoints are of joints.
        ik_orientation: quaternion xyzw that this link keeps, world frame; None:
            setpoints have it.
        num_arm_joints: how many joints are the arm's.
        arm_mode: what setpoints of the arm's joints are.
    """

    forces: tuple[float, ...]
    ik_link: int | None = None
    ik_orientation: tuple[float, float, float, float] | None = None
    num_arm_joints: int = 0
    arm_mode: ArmMode = "position"

    @property
    def setpoint_dim(self) -> int:
        """Number of entries of a setpoint."""
        if self.ik_link is None:
            return len(self.forces)
        return self._pose_dim + len(self.forces) - self.num_arm_joints

    @property
    def num_unheld_joints(self) -> int:
        """How many joints, the first ones, are not driven to positions."""
        return 0 if self.arm_mode == "position" else self.num_arm_joints

    @property
    def _pose_dim(self) -> int:
        return 7 if self.ik_orientation is None else 3

    def check(self, setpoint: Doubles, num_envs: int, num_joints: int) -> None:
        """Make sure that this control drives these robots to these setpoints.

        Raises:
            ValueError: it has the forces of another robot, or other setpoints.
        """
        if len(self.forces) != num_joints:
            raise ValueError(
                f"a MotorControl needs a force for each of {num_joints} joints, "
                f"got {len(self.forces)}"
            )
        if setpoint.shape != (num_envs, self.setpoint_dim):
            raise ValueError(
                f"the setpoint must have shape {(num_envs, self.setpoint_dim)}, "
                f"got {setpoint.shape}"
            )

    def __call__(self, client: PhysicsClient, body: int, setpoint: Doubles) -> None:
        """Set the motors of one client's robot."""
        joints = setpoint
        if self.ik_link is not None:
            pose = setpoint[: self._pose_dim]
            joints = np.empty(len(self.forces))
            orientation = self.ik_orientation or pose[3:].tolist()
            client.inverse_kinematics(body, self.ik_link, pose[:3], orientation, joints)
            joints[self.num_arm_joints :] = setpoint[self._pose_dim :]
        free = self.num_unheld_joints
        velocities = setpoint[:free] if self.arm_mode == "velocity" else np.zeros(free)
        forces = self.forces
        if self.arm_mode == "torque":  # the motors must not brake
            forces = (0.0,) * free + forces[free:]
        client.control_joints(body, joints[free:], forces, velocities)

    def advance(
        self, client: PhysicsClient, body: int, setpoint: Doubles, count: int
    ) -> None:
        """Take ``count`` time steps, for which the motors are set."""
        if self.arm_mode != "torque":
            client.step(count)
            return
        torques = setpoint[: self.num_arm_joints]
        for _ in range(count):  # Bullet forgets torques when it has stepped
            client.apply_torques(body, torques)
            client.step()
