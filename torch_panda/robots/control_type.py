"""What an action does."""

from typing import Literal

from torch_panda.bullet.control import ArmMode

ControlType = Literal["ee", "ee_pose", "joints", "joint_velocity", "joint_torque"]

# What an action of 1 is: the end-effector's or a joint's displacement [m] or [rad], or
# a joint's velocity, so that it moves as far in a step of 40 ms [rad/s], or a part of
# the force that its motor may exert.
ACTION_SCALES: dict[ControlType, float] = {
    "ee": 0.05,
    "ee_pose": 0.05,
    "joints": 0.05,
    "joint_velocity": 1.25,
    "joint_torque": 1.0,
}
ARM_MODES: dict[ControlType, ArmMode] = {
    "joint_velocity": "velocity",
    "joint_torque": "torque",
}
