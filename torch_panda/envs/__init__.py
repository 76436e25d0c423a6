"""The environment that joins a robot and a task."""

from torch_panda.envs.robot_task import OnDivergence, RobotTaskEnv
from torch_panda.envs.state_transform import StateTransform

__all__ = ["OnDivergence", "RobotTaskEnv", "StateTransform"]
