"""Goal-conditioned Franka Panda tasks as one vectorised TorchRL environment."""

from torch_panda.bullet import BulletError, PhysicsName, PhysicsParams
from torch_panda.envs import RobotTaskEnv
from torch_panda.registry import ENV_IDS, make
from torch_panda.robots import Panda, Robot
from torch_panda.tasks import (
    Flip,
    PickAndPlace,
    Push,
    Reach,
    Slide,
    Stack,
    Task,
)

__all__ = [
    "ENV_IDS",
    "BulletError",
    "Flip",
    "Panda",
    "PhysicsName",
    "PhysicsParams",
    "PickAndPlace",
    "Push",
    "Reach",
    "Robot",
    "RobotTaskEnv",
    "Slide",
    "Stack",
    "Task",
    "make",
]
