"""Robots: their URDFs, the meaning of actions, and observations."""

from torch_panda.bullet.urdf import Tool
from torch_panda.robots.base import ControlType, Robot
from torch_panda.robots.gripper import Gripper
from torch_panda.robots.kuka import Kuka
from torch_panda.robots.panda import Panda
from torch_panda.robots.xarm import XArm6, XArm6Gripper

__all__ = [
    "ControlType",
    "Gripper",
    "Kuka",
    "Panda",
    "Robot",
    "Tool",
    "XArm6",
    "XArm6Gripper",
]
