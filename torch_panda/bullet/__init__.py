"""Bullet's C API: one client, and many of them stepped in parallel."""

from torch_panda.bullet.client import PhysicsClient
from torch_panda.bullet.connection import BulletError
from torch_panda.bullet.control import Control, MotorControl
from torch_panda.bullet.guard import ThreadGuard
from torch_panda.bullet.physics import (
    EXACT,
    FAST,
    PhysicsName,
    PhysicsParams,
    read_physics,
)
from torch_panda.bullet.pool import WorkerError, WorkerPool
from torch_panda.bullet.scene import Scene
from torch_panda.bullet.shapes import Box, Cylinder, Sphere, Visual
from torch_panda.bullet.simulation import VectorSimulation

__all__ = [
    "EXACT",
    "FAST",
    "Box",
    "BulletError",
    "Control",
    "Cylinder",
    "MotorControl",
    "PhysicsClient",
    "PhysicsName",
    "PhysicsParams",
    "Scene",
    "Sphere",
    "ThreadGuard",
    "VectorSimulation",
    "Visual",
    "WorkerError",
    "WorkerPool",
    "read_physics",
]
