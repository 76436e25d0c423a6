"""The environment that joins a robot and a task."""

from torch_panda.envs.robot_task import OnDivergence, RobotTaskEnv

__all__ = ["OnDivergence", "RobotTaskEnv"]
