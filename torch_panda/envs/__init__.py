"""The environment that joins a robot and a task."""

from torch_panda.envs.robot_task import RobotTaskEnv

__all__ = ["RobotTaskEnv"]
