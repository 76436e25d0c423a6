"""Bullet's C API: one client, and many clients stepped in parallel."""

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
