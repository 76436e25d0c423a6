"""Robots: what they are made of, how an action moves them, what they observe."""

from torch_panda.robots.base import ControlType, Robot
from torch_panda.robots.panda import Panda

__all__ = ["ControlType", "Panda", "Robot"]
