"""The KUKA LBR iiwa 14 arm."""

from typing import Any

from torch_panda.robots.base import Robot

# A hand above the table that points down [rad].
NEUTRAL_JOINT_POSITION = (0.0, 0.5, 0.0, -1.5, 0.0, 1.1, 0.0)
# KUKA's data sheet [N m].
JOINT_FORCES = (320.0, 320.0, 176.0, 176.0, 110.0, 40.0, 40.0)
EE_LINK = 6


class Kuka(Robot):
    """The KUKA LBR iiwa 14 arm: 7 joints, no gripper.

    Args:
        **options: of `Robot`, but for those of the URDF and the gripper.
    """

    def __init__(self, **options: Any) -> None:  # noqa: ANN401 (of Robot)
        super().__init__(
            urdf="kuka_iiwa/model.urdf",
            neutral_joint_position=NEUTRAL_JOINT_POSITION,
            joint_forces=JOINT_FORCES,
            ee_link=EE_LINK,
            ee_orientation=(0.0, 1.0, 0.0, 0.0),
            **options,
        )
