"""The Franka Emika Panda arm with its gripper."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_panda.bullet import PhysicsClient, VectorSimulation
from torch_panda.robots.base import ControlType, Robot

# The same in panda-gym 1.1.0 and 3.0.7.
NEUTRAL_JOINT_POSITION = (0.0, 0.41, 0.0, -1.85, 0.0, 2.26, 0.79, 0.0, 0.0)
JOINT_FORCES = (87.0, 87.0, 87.0, 87.0, 12.0, 120.0, 120.0, 170.0, 170.0)
EE_LINK = 11
# The hand's mount, where the real arm carries a force and torque sensor.
WRIST_JOINT = 8
FINGER_LINKS = (9, 10)
LARGEST_WIDTH = 0.08  # [m], between the fingers
# An action of 1 opens the fingers by this much [m].
GRIPPER_SCALE = 0.2


class Panda(Robot):
    """The Franka Emika Panda arm: 7 joints and two fingers.

    Actions are 3 displacements of the end-effector or 7 of the joints, and one of the
    fingers unless the gripper is blocked. Observations are the end-effector's position
    [m] and velocity [m/s], and the distance between the fingers [m] unless the gripper
    is blocked.

    Args:
        control_type: "ee" or "joints".
        block_gripper: keep the fingers as they start, by default closed.
        base_position: of the base, world frame [m].
        fingers_width: distance between the fingers at the start of an episode [m].
        finger_friction: lateral friction of the fingers.
        finger_spinning_friction: of the fingers; None leaves what the URDF has, 0.1.
    """

    def __init__(
        self,
        *,
        control_type: ControlType = "ee",
        block_gripper: bool = False,
        base_position: Sequence[float] = (-0.6, 0.0, 0.0),
        fingers_width: float = 0.0,
        finger_friction: float = 1.0,
        finger_spinning_friction: float | None = None,
    ) -> None:
        if not 0 <= fingers_width <= LARGEST_WIDTH:
            raise ValueError(
                f"fingers_width must be from 0 to {LARGEST_WIDTH} [m], got "
                f"{fingers_width}"
            )
        fingers = (fingers_width / 2,) * 2
        super().__init__(
            urdf="franka_panda/panda.urdf",
            neutral_joint_position=(*NEUTRAL_JOINT_POSITION[:7], *fingers),
            joint_forces=JOINT_FORCES,
            ee_link=EE_LINK,
            num_arm_joints=7,
            control_type=control_type,
            base_position=base_position,
            wrist_joint=WRIST_JOINT,
            finger_links=FINGER_LINKS,
        )
        self.block_gripper = block_gripper
        self.finger_friction = finger_friction
        self.finger_spinning_friction = finger_spinning_friction

    @property
    def action_dim(self) -> int:
        """Number of action entries."""
        return super().action_dim + (not self.block_gripper)

    @property
    def observation_dim(self) -> int:
        """Number of entries of its part of the observation."""
        return super().observation_dim + (not self.block_gripper)

    def build(self, client: PhysicsClient) -> int:
        """Load the arm, and let its fingers grip."""
        body = super().build(client)
        for link in FINGER_LINKS:
            client.set_friction(
                body,
                link,
                lateral=self.finger_friction,
                spinning=self.finger_spinning_friction,
            )
        return body

    def setpoint(self, action: Tensor, simulation: VectorSimulation) -> Tensor:
        """What actions ask the motors for; see `Robot.setpoint`."""
        if self.block_gripper:
            return super().setpoint(action, simulation)
        arm = self.arm_setpoint(action, simulation)
        # In float32 throughout: so panda-gym computes it under NumPy 2.
        width = self.fingers_width(simulation).float()
        finger = (width + action[:, -1:] * GRIPPER_SCALE) / 2
        return torch.cat((arm, finger.double().expand(-1, 2)), dim=1)

    def observation(self, simulation: VectorSimulation) -> Tensor:
        """Position, velocity and fingers' width: (num_envs, 6 or 7), float64."""
        observation = super().observation(simulation)
        if self.block_gripper:
            return observation
        return torch.cat((observation, self.fingers_width(simulation)), dim=1)

    def fingers_width(self, simulation: VectorSimulation) -> Tensor:
        """Distance between the fingers [m]: (num_envs, 1), float64."""
        return simulation.joint_position[:, self.num_arm_joints :].sum(1, keepdim=True)
