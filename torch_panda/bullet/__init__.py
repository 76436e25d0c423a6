"""Bullet's C API: one client, and many clients stepped in parallel."""

import warnings
from collections.abc import Callable
from typing import Any

from torch_panda.bullet.blueprint import Blueprint
from torch_panda.bullet.client import PhysicsClient
from torch_panda.bullet.connection import BulletError
from torch_panda.bullet.control import Control, MotorControl
from torch_panda.bullet.physics import (
    EXACT,
    FAST,
    PhysicsName,
    PhysicsParams,
    resolve_physics,
)
from torch_panda.bullet.pool import WorkerError, WorkerPool
from torch_panda.bullet.scene import Scene
from torch_panda.bullet.shapes import Box, Cylinder, Sphere, Visual
from torch_panda.bullet.simulation import VectorSimulation
from torch_panda.bullet.state import SimulationState

__all__ = [
    "EXACT",
    "FAST",
    "Blueprint",
    "Box",
    "BulletError",
    "Control",
    "Cylinder",
    "MotorControl",
    "PhysicsClient",
    "PhysicsName",
    "PhysicsParams",
    "Scene",
    "SimulationState",
    "Sphere",
    "VectorSimulation",
    "Visual",
    "WorkerError",
    "WorkerPool",
    "resolve_physics",
]


def __getattr__(name: str) -> Callable[..., Any]:
    """Let tasks that still import ``selects_state`` work, and say that it has gone."""
    if name != "selects_state":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    warnings.warn(
        "selects_state is no longer needed: delete the import and the decorators",
        FutureWarning,
        stacklevel=2,
    )
    return lambda function: function
