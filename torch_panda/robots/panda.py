"""The Franka Emika Panda arm with its gripper."""

from collections.abc import Sequence

from torch_panda.bullet import PhysicsClient
from torch_panda.checks import check_not_negative
from torch_panda.robots.base import ABOVE_THE_TABLE, ControlType, Robot, Workspace
from torch_panda.robots.gripper import Gripper
from torch_panda.rotations import NO_ROTATION

# The same in panda-gym 1.1.0 and 3.0.7.
NEUTRAL_JOINT_POSITION = (0.0, 0.41, 0.0, -1.85, 0.0, 2.26, 0.79, 0.0, 0.0)
JOINT_FORCES = (87.0, 87.0, 87.0, 87.0, 12.0, 120.0, 120.0, 170.0, 170.0)
EE_LINK = 11
WRIST_JOINT = 8  # the fixed joint that carries the hand
FINGER_LINKS = (9, 10)
GRIPPER = Gripper(closed=(0.0, 0.0), opened=(0.04, 0.04), width=0.08)


class Panda(Robot):
    """The Franka Emika Panda arm: 7 joints and two fingers.

    `Robot` explains the arguments that are not listed here.

    Args:
        fingers_width: Distance between the fingers at the start of an episode [m].
        finger_friction: Lateral friction of the fingers; None means the URDF's.
        finger_spinning_friction: Spinning friction of the fingers; None means the
            URDF's 0.1.

    Raises:
        ValueError: An argument is out of range.
    """

    def __init__(
        self,
        *,
        control_type: ControlType = "ee",
        action_scale: float | None = None,
        block_gripper: bool = False,
        base_position: Sequence[float] = (-0.6, 0.0, 0.0),
        base_orientation: Sequence[float] = NO_ROTATION,
        workspace: Workspace = ABOVE_THE_TABLE,
        fingers_width: float = 0.0,
        finger_friction: float | None = 1.0,
        finger_spinning_friction: float | None = None,
    ) -> None:
        check_not_negative(fingers_width=fingers_width)
        if finger_spinning_friction is not None:
            check_not_negative(finger_spinning_friction=finger_spinning_friction)
        if fingers_width > GRIPPER.width:
            raise ValueError(
                f"fingers_width must be from 0 to {GRIPPER.width} [m], got "
                f"{fingers_width}"
            )
        fingers = (fingers_width / 2,) * 2
        super().__init__(
            urdf="franka_panda/panda.urdf",
            neutral_joint_position=(*NEUTRAL_JOINT_POSITION[:7], *fingers),
            effort_limits=JOINT_FORCES,
            ee_link=EE_LINK,
            num_arm_joints=7,
            control_type=control_type,
            action_scale=action_scale,
            gripper=GRIPPER,
            block_gripper=block_gripper,
            base_position=base_position,
            base_orientation=base_orientation,
            workspace=workspace,
            wrist_joint=WRIST_JOINT,
            finger_links=FINGER_LINKS,
            finger_friction=finger_friction,
        )
        self._fingers_width = fingers_width
        self.finger_spinning_friction = finger_spinning_friction

    def build(self, client: PhysicsClient) -> int:
        """Load the robot and set the friction of its fingers."""
        body = super().build(client)
        if self.finger_spinning_friction is not None:
            for link in FINGER_LINKS:
                client.set_friction(body, link, spinning=self.finger_spinning_friction)
        return body
