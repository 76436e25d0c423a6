"""Goal-conditioned Franka Panda tasks as one vectorised TorchRL environment."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from torch_panda.bullet import BulletError, PhysicsName, PhysicsParams, WorkerError
from torch_panda.envs import RobotTaskEnv
from torch_panda.envs.randomization import Randomization
from torch_panda.registry import (
    ENV_IDS,
    make,
    max_episode_steps,
    register,
    register_all_with_gymnasium,
)
from torch_panda.rendering import Camera, HandCamera
from torch_panda.robots import Gripper, Kuka, Panda, Robot, XArm6, XArm6Gripper
from torch_panda.sensors import CameraSensor, ForceSensor, Sensor
from torch_panda.tasks import (
    Drawer,
    Flip,
    PegInsertion,
    PickAndPlace,
    Push,
    Reach,
    Slide,
    Stack,
    Task,
)

__version__ = "0.1.0"

__all__ = [
    "ENV_IDS",
    "BulletError",
    "Camera",
    "CameraSensor",
    "Drawer",
    "Flip",
    "ForceSensor",
    "Gripper",
    "HandCamera",
    "Kuka",
    "Panda",
    "PegInsertion",
    "PhysicsName",
    "PhysicsParams",
    "PickAndPlace",
    "Push",
    "Randomization",
    "Reach",
    "Robot",
    "RobotTaskEnv",
    "Sensor",
    "Slide",
    "Stack",
    "Task",
    "WorkerError",
    "XArm6",
    "XArm6Gripper",
    "evaluate",
    "evaluation_tasks",
    "load_policy",
    "make",
    "max_episode_steps",
    "register",
]

if TYPE_CHECKING:
    from torch_panda.learning.evaluation import evaluate
    from torch_panda.learning.evaluation.fixed_tasks import evaluation_tasks
    from torch_panda.learning.files.policy_files import load_policy

# Imported at their first use: torchrl's losses take long to import.
_MODULES = {
    "evaluate": "torch_panda.learning.evaluation",
    "evaluation_tasks": "torch_panda.learning.evaluation.fixed_tasks",
    "load_policy": "torch_panda.learning.files.policy_files",
}


def __getattr__(name: str) -> Any:  # noqa: ANN401
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


# Importing the package registers the ids, so that Gymnasium users can write
# `gymnasium.register_envs(torch_panda)`, as for other packages.
register_all_with_gymnasium()
