"""The UFACTORY xArm 6, with and without its gripper."""

from collections.abc import Sequence

from torch_panda.bullet.urdf import Tool
from torch_panda.robots.base import ABOVE_THE_TABLE, ControlType, Robot, Workspace
from torch_panda.robots.gripper import Gripper
from torch_panda.rotations import NO_ROTATION

# The hand is above the table and points down [rad].
NEUTRAL_ARM = (0.0, 0.22, -0.83, 0.0, 0.61, 0.0)
NEUTRAL_ARM_WITH_GRIPPER = (0.0, -0.06, -1.01, 0.0, 1.07, 0.0)
ARM_FORCES = (50.0, 50.0, 32.0, 32.0, 32.0, 20.0)  # from the URDF [N m]
# Nearer to the goals than the Panda's base, because the reach is only 0.7 m.
BASE_POSITION = (-0.45, 0.0, 0.0)  # [m]

# In the real gripper the first joint drives the others.
GRIPPER = Gripper(
    closed=(0.85,) * 6, opened=(0.0,) * 6, width=0.089, mimic_joints=(1, 2, 3, 4, 5)
)
GRIPPER_FORCES = (8.0, 50.0, 50.0, 50.0, 50.0, 50.0)  # [N m]
# Between the fingertips, where they hold a cube.
TOOL = Tool("xarm_gripper_base_link", (0.0, 0.0, 0.16))
TOOL_LINK = 14
FINGER_LINKS = (9, 12)


class XArm6(Robot):
    """The xArm 6: 6 joints and no gripper.

    `Robot` explains the arguments.
    """

    def __init__(
        self,
        *,
        control_type: ControlType = "ee",
        action_scale: float | None = None,
        base_position: Sequence[float] = BASE_POSITION,
        base_orientation: Sequence[float] = NO_ROTATION,
        workspace: Workspace = ABOVE_THE_TABLE,
    ) -> None:
        super().__init__(
            urdf="xarm/xarm6_robot.urdf",
            neutral_joint_position=NEUTRAL_ARM,
            effort_limits=ARM_FORCES,
            ee_link=6,
            control_type=control_type,
            action_scale=action_scale,
            base_position=base_position,
            base_orientation=base_orientation,
            workspace=workspace,
        )


class XArm6Gripper(Robot):
    """The xArm 6 with its gripper: 6 joints of the arm and 6 of the fingers.

    `Robot` explains the arguments.
    """

    def __init__(
        self,
        *,
        control_type: ControlType = "ee",
        action_scale: float | None = None,
        block_gripper: bool = False,
        base_position: Sequence[float] = BASE_POSITION,
        base_orientation: Sequence[float] = NO_ROTATION,
        workspace: Workspace = ABOVE_THE_TABLE,
        finger_friction: float | None = 1.0,
    ) -> None:
        super().__init__(
            urdf="xarm/xarm6_with_gripper.urdf",
            neutral_joint_position=(*NEUTRAL_ARM_WITH_GRIPPER, *GRIPPER.closed),
            effort_limits=(*ARM_FORCES, *GRIPPER_FORCES),
            ee_link=TOOL_LINK,
            control_type=control_type,
            action_scale=action_scale,
            gripper=GRIPPER,
            block_gripper=block_gripper,
            base_position=base_position,
            base_orientation=base_orientation,
            workspace=workspace,
            tool=TOOL,
            finger_links=FINGER_LINKS,
            finger_friction=finger_friction,
        )
