"""Bullet's C API: one client, and many of them stepped in parallel."""

from torch_panda.bullet.client import BulletError, PhysicsClient
from torch_panda.bullet.physics import (
    EXACT,
    FAST,
    PhysicsName,
    PhysicsParams,
    read_physics,
)
from torch_panda.bullet.pool import WorkerError
from torch_panda.bullet.simulation import ControlType, Scene, VectorSimulation

__all__ = [
    "EXACT",
    "FAST",
    "BulletError",
    "ControlType",
    "PhysicsClient",
    "PhysicsName",
    "PhysicsParams",
    "Scene",
    "VectorSimulation",
    "WorkerError",
    "read_physics",
]
