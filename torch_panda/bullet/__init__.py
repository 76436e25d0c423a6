"""Bullet's C API: one client, and many of them stepped in parallel."""

from torch_panda.bullet.client import BulletError, PhysicsClient
from torch_panda.bullet.pool import WorkerError
from torch_panda.bullet.simulation import ControlType, Scene, VectorSimulation

__all__ = [
    "BulletError",
    "ControlType",
    "PhysicsClient",
    "Scene",
    "VectorSimulation",
    "WorkerError",
]
