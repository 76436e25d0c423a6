"""Bullet's C API: one client, and many of them stepped in parallel."""

from torch_panda.bullet.camera import Camera
from torch_panda.bullet.client import BulletError, PhysicsClient
from torch_panda.bullet.physics import (
    EXACT,
    FAST,
    PhysicsName,
    PhysicsParams,
    read_physics,
)
from torch_panda.bullet.pool import WorkerError, WorkerPool
from torch_panda.bullet.shapes import Box, Cylinder, Look, Sphere
from torch_panda.bullet.simulation import ControlType, Scene, VectorSimulation
from torch_panda.bullet.visual import VisualClient

__all__ = [
    "EXACT",
    "FAST",
    "Box",
    "BulletError",
    "Camera",
    "ControlType",
    "Cylinder",
    "Look",
    "PhysicsClient",
    "PhysicsName",
    "PhysicsParams",
    "Scene",
    "Sphere",
    "VectorSimulation",
    "VisualClient",
    "WorkerError",
    "WorkerPool",
    "read_physics",
]
