"""Goal-conditioned Franka Panda tasks as one vectorised TorchRL environment."""

from torch_panda.bullet import (
    BulletError,
    Camera,
    PhysicsName,
    PhysicsParams,
    WorkerError,
)
from torch_panda.envs import RobotTaskEnv
from torch_panda.gymnasium_envs import register_envs
from torch_panda.registry import ENV_IDS, make, max_episode_steps
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
    "Camera",
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
    "WorkerError",
    "make",
    "max_episode_steps",
]

register_envs()
