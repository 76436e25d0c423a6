"""The KUKA LBR iiwa 14 arm."""

from collections.abc import Sequence

from torch_panda.robots.base import ABOVE_THE_TABLE, ControlType, Robot, Workspace
from torch_panda.rotations import NO_ROTATION

# The hand is above the table and points down [rad].
NEUTRAL_JOINT_POSITION = (0.0, 0.5, 0.0, -1.5, 0.0, 1.1, 0.0)
# From KUKA's data sheet [N m].
JOINT_FORCES = (320.0, 320.0, 176.0, 176.0, 110.0, 40.0, 40.0)
EE_LINK = 6


class Kuka(Robot):
    """The KUKA LBR iiwa 14 arm: 7 joints and no gripper.

    `Robot` explains the arguments.
    """

    def __init__(
        self,
        *,
        control_type: ControlType = "ee",
        action_scale: float | None = None,
        base_position: Sequence[float] = (-0.6, 0.0, 0.0),
        base_orientation: Sequence[float] = NO_ROTATION,
        workspace: Workspace = ABOVE_THE_TABLE,
    ) -> None:
        super().__init__(
            urdf="kuka_iiwa/model.urdf",
            neutral_joint_position=NEUTRAL_JOINT_POSITION,
            effort_limits=JOINT_FORCES,
            ee_link=EE_LINK,
            ee_orientation=(0.0, 1.0, 0.0, 0.0),
            control_type=control_type,
            action_scale=action_scale,
            base_position=base_position,
            base_orientation=base_orientation,
            workspace=workspace,
        )
