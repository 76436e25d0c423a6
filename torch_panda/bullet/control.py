"""What sets the motors of a robot."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from torch_panda.bullet.body_state import Doubles
from torch_panda.bullet.client import PhysicsClient

# Sets the motors of one client's robot, in the thread that steps the client, given the
# client, the robot's body id and a row of setpoints.
Control = Callable[[PhysicsClient, int, Doubles], None]


@dataclass(frozen=True)
class PositionControl:
    """Drives all movable joints of a robot to positions.

    It is a `Control`, and as data one that the native loop carries out without Python.
    A setpoint holds the positions of all joints [rad] or [m]; or, with an ``ik_link``,
    where the centre of mass of that link is to be, world frame [m], and behind it the
    positions of the joints that are not the arm's.

    Attributes:
        forces: the most each joint's motor may exert [N m] or [N].
        ik_link: the link for which inverse kinematics find the arm's joint positions;
            None: setpoints are of joints.
        ik_orientation: quaternion xyzw that this link keeps, world frame.
        num_arm_joints: how many joints, the first ones, inverse kinematics move.
    """

    forces: tuple[float, ...]
    ik_link: int | None = None
    ik_orientation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    num_arm_joints: int = 0

    @property
    def setpoint_dim(self) -> int:
        """Number of entries of a setpoint."""
        if self.ik_link is None:
            return len(self.forces)
        return 3 + len(self.forces) - self.num_arm_joints

    def check(self, setpoint: Doubles, num_envs: int, num_joints: int) -> None:
        """Make sure that this control drives these robots to these setpoints.

        Raises:
            ValueError: it has the forces of another robot, or other setpoints.
        """
        if len(self.forces) != num_joints:
            raise ValueError(
                f"a PositionControl needs a force for each of {num_joints} joints, "
                f"got {len(self.forces)}"
            )
        if setpoint.shape != (num_envs, self.setpoint_dim):
            raise ValueError(
                f"the setpoint must have shape {(num_envs, self.setpoint_dim)}, "
                f"got {setpoint.shape}"
            )

    def __call__(self, client: PhysicsClient, body: int, setpoint: Doubles) -> None:
        """Set the motors of one client's robot."""
        if self.ik_link is None:
            client.control_joints(body, setpoint, self.forces)
            return
        joints = np.empty(len(self.forces))
        client.inverse_kinematics(
            body, self.ik_link, setpoint[:3], self.ik_orientation, joints
        )
        joints[self.num_arm_joints :] = setpoint[3:]
        client.control_joints(body, joints, self.forces)
