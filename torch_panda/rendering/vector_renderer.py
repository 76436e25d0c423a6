"""Renders many environments in parallel."""

import math
import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from torch_panda.bullet import VectorSimulation, WorkerPool
from torch_panda.rendering.camera import Camera
from torch_panda.rendering.egl import RendererName
from torch_panda.rendering.frames import Frames

if TYPE_CHECKING:  # imported with the first picture
    from torch_panda.rendering.env_renderer import EnvRenderer

# Smallest cells in which merging the vertices of a mesh saves time [m].
_FINEST_CELL = 0.004


class VectorRenderer:
    """Draws the environments of a simulation in parallel.

    Each thread uses an `EnvRenderer` of its own. The first picture builds the renderers
    that it needs. For small pictures, the robot's meshes are coarsened to cells of half
    a pixel (see `mesh_cell`).

    Args:
        simulation: The simulation whose environments are drawn. Its threads also draw.
        renderer: "tiny", Bullet's software renderer, or "egl", its OpenGL renderer.
            "egl" draws in one separate thread, because an OpenGL context belongs to one
            thread.
    """

    def __init__(self, simulation: VectorSimulation, *, renderer: RendererName) -> None:
        self._simulation = simulation
        self._renderer: RendererName = renderer
        # Idle renderers by mesh cell. Threads share these lists without a lock, because
        # the GIL makes `pop` and `append` atomic.
        self._idle: dict[float, list[EnvRenderer]] = {}
        self._gl_thread = WorkerPool(1) if renderer == "egl" else None

    def draw(
        self, envs: Sequence[int], camera: Camera, frames: Frames, rows: Sequence[int]
    ) -> None:
        """Draw environments into rows of ``frames``; see `EnvRenderer.draw`.

        Raises:
            WorkerError: Bullet failed in at least one picture.
        """
        jobs = list(zip(envs, rows, strict=True))
        run = self._simulation.run if self._gl_thread is None else self._gl_thread.run
        cell = mesh_cell(camera) if self._gl_thread is None else 0.0
        threads = self._simulation.num_threads if self._gl_thread is None else 1
        renderers = self._provide(cell, min(threads, len(jobs)))

        def work(job: int) -> None:
            env, row = jobs[job]
            renderer = renderers.pop()
            try:
                renderer.draw(env, camera, frames, row)
            finally:
                renderers.append(renderer)

        run(work, range(len(jobs)))

    def picture(self, envs: Sequence[int], camera: Camera) -> Tensor:
        """Draw environments: (len(envs), height, width, 3) uint8; see `draw`."""
        frames = Frames.allocate(len(envs), camera)
        self.draw(envs, camera, frames, range(len(envs)))
        return frames.pixels

    def close(self) -> None:
        """Free all renderers. Closing again does nothing."""
        renderers = [renderer for idle in self._idle.values() for renderer in idle]
        self._idle = {}
        if self._gl_thread is None:
            for renderer in renderers:
                renderer.close()
        elif threading.main_thread().is_alive():  # else Python has ended all threads
            self._gl_thread.run(lambda k: renderers[k].close(), range(len(renderers)))
            self._gl_thread.close()

    def _provide(self, cell: float, count: int) -> list["EnvRenderer"]:
        """The idle renderers for a mesh cell, at least ``count`` of them.

        Missing renderers are made one by one, because Bullet's importer is not
        thread-safe.
        """
        from torch_panda.rendering.env_renderer import EnvRenderer

        renderers = self._idle.setdefault(cell, [])

        def make(_: int) -> None:
            renderers.append(
                EnvRenderer(self._simulation, renderer=self._renderer, mesh_cell=cell)
            )

        missing = range(len(renderers), count)
        if self._gl_thread is None:
            for index in missing:
                make(index)
        else:
            self._gl_thread.run(make, missing)
        return renderers


def mesh_cell(camera: Camera) -> float:
    """Mesh cell that suits a camera's pictures [m].

    It is half the size of a pixel at the camera's target, rounded to millimetres. Cells
    below `_FINEST_CELL` would not save time. The result is then 0, which draws all
    details.
    """
    pixel = 2 * camera.distance * math.tan(math.radians(camera.fov) / 2) / camera.height
    cell = round(pixel / 2, 3)
    return cell if cell >= _FINEST_CELL else 0.0
