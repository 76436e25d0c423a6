"""Control types: the meanings of an action."""

from typing import Literal

from torch_panda.bullet.control import ArmMode

ControlType = Literal["ee", "ee_pose", "joints", "joint_velocity", "joint_torque"]

# Displacement [m] or [rad], velocity [rad/s], or share of the motor's largest force for
# an action of 1. At 1.25 rad/s a joint moves 0.05 rad in a step of 40 ms.
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
