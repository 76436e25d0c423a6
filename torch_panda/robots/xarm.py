"""The UFACTORY xArm 6, with and without its gripper."""

from collections.abc import Sequence
from typing import Any

from torch_panda.bullet import PhysicsClient
from torch_panda.bullet.urdf import Tool
from torch_panda.robots.base import Robot
from torch_panda.robots.gripper import Gripper

# Hands above the table that point down [rad].
NEUTRAL_ARM = (0.0, 0.22, -0.83, 0.0, 0.61, 0.0)
NEUTRAL_ARM_WITH_GRIPPER = (0.0, -0.06, -1.01, 0.0, 1.07, 0.0)
ARM_FORCES = (50.0, 50.0, 32.0, 32.0, 32.0, 20.0)  # the URDF's [N m]
# Its reach is 0.7 m.
BASE_POSITION = (-0.45, 0.0, 0.0)  # [m]

# The first joint drives; the real gripper couples the others to it.
GRIPPER = Gripper(
    closed=(0.85,) * 6, opened=(0.0,) * 6, width=0.089, followers=(1, 2, 3, 4, 5)
)
GRIPPER_FORCES = (8.0, 50.0, 50.0, 50.0, 50.0, 50.0)  # [N m]
# Between the fingertips, where they hold a cube.
TOOL = Tool("xarm_gripper_base_link", (0.0, 0.0, 0.16))
TOOL_LINK = 14
FINGER_LINKS = (9, 12)


class XArm6(Robot):
    """The xArm 6: 6 joints, no gripper.

    Args:
        base_position: of the base, world frame [m].
        **options: of `Robot`, but for those of the URDF and the gripper.
    """

    def __init__(
        self,
        *,
        base_position: Sequence[float] = BASE_POSITION,
        **options: Any,  # noqa: ANN401 (of Robot)
    ) -> None:
        super().__init__(
            urdf="xarm/xarm6_robot.urdf",
            neutral_joint_position=NEUTRAL_ARM,
            joint_forces=ARM_FORCES,
            ee_link=6,
            base_position=base_position,
            **options,
        )


class XArm6Gripper(Robot):
    """The xArm 6 with its gripper: 6 joints of the arm and 6 of the fingers.

    Args:
        base_position: of the base, world frame [m].
        finger_friction: lateral friction of the fingers.
        **options: of `Robot`, but for those of the URDF.
    """

    def __init__(
        self,
        *,
        base_position: Sequence[float] = BASE_POSITION,
        finger_friction: float = 1.0,
        **options: Any,  # noqa: ANN401 (of Robot)
    ) -> None:
        super().__init__(
            urdf="xarm/xarm6_with_gripper.urdf",
            neutral_joint_position=(*NEUTRAL_ARM_WITH_GRIPPER, *GRIPPER.closed),
            joint_forces=(*ARM_FORCES, *GRIPPER_FORCES),
            ee_link=TOOL_LINK,
            base_position=base_position,
            gripper=GRIPPER,
            tool=TOOL,
            finger_links=FINGER_LINKS,
            **options,
        )
        self.finger_friction = finger_friction

    def build(self, client: PhysicsClient) -> int:
        """Load the arm, and let its fingers grip."""
        body = super().build(client)
        for link in FINGER_LINKS:
            client.set_friction(body, link, lateral=self.finger_friction)
        return body
