"""Drawing many environments in parallel."""

import math
import sys
from collections.abc import Callable, Sequence

from torch import Tensor

from torch_panda.bullet import Camera, VectorSimulation, WorkerPool
from torch_panda.bullet.renderers import RendererName
from torch_panda.envs.twin import Frames, VisualTwin

# Meshes finer than this are drawn as they are [m].
_FINEST_CELL = 0.004


class Renderer:
    """Draws the environments of a simulation, each thread with a visual twin.

    Nothing is built before something is drawn. In small pictures the robot's meshes
    are merged to cells of half a pixel (see `mesh_cell`).

    Args:
        simulation: what is drawn, by its own threads.
        make_twin: makes a twin of its scene, with a `mesh_cell`.
        renderer: "tiny": Bullet's software renderer; "egl": its OpenGL renderer, in
            one thread of its own, because a context of OpenGL belongs to a thread.
    """

    def __init__(
        self,
        simulation: VectorSimulation,
        make_twin: Callable[[float], VisualTwin],
        *,
        renderer: RendererName = "tiny",
    ) -> None:
        self._simulation = simulation
        self._make_twin = make_twin
        # Idle twins by mesh cell; lists are popped and appended to under the GIL.
        self._twins: dict[float, list[VisualTwin]] = {}
        self._gl_thread = WorkerPool(1) if renderer == "egl" else None

    def draw(
        self, envs: Sequence[int], camera: Camera, frames: Frames, rows: Sequence[int]
    ) -> None:
        """Draw environments into rows of ``frames``; see `VisualTwin.draw`.

        Raises:
            WorkerError: Bullet failed in one twin.
        """
        jobs = list(zip(envs, rows, strict=True))
        run = self._simulation.run if self._gl_thread is None else self._gl_thread.run
        cell = mesh_cell(camera) if self._gl_thread is None else 0.0
        threads = self._simulation.num_threads if self._gl_thread is None else 1
        twins = self._have_twins(cell, min(threads, len(jobs)))

        def work(job: int) -> None:
            env, row = jobs[job]
            twin = twins.pop()
            try:
                twin.draw(self._simulation, env, camera, frames, row)
            finally:
                twins.append(twin)

        run(work, range(len(jobs)))

    def picture(self, envs: Sequence[int], camera: Camera) -> Tensor:
        """Draw environments: (len(envs), height, width, 3) uint8; see `draw`."""
        frames = Frames.allocate(len(envs), camera)
        self.draw(envs, camera, frames, range(len(envs)))
        return frames.pixels

    def close(self) -> None:
        """Free all twins. Closing again does nothing."""
        twins = [twin for idle in self._twins.values() for twin in idle]
        self._twins = {}
        if self._gl_thread is None:
            for twin in twins:
                twin.close()
        elif not sys.is_finalizing():  # when Python ends, its threads already have
            self._gl_thread.run(lambda k: twins[k].close(), range(len(twins)))
            self._gl_thread.close()

    def _have_twins(self, cell: float, count: int) -> list[VisualTwin]:
        """At least so many, made one by one: Bullet's importer is not for threads."""
        twins = self._twins.setdefault(cell, [])
        missing = range(len(twins), count)
        if self._gl_thread is None:
            twins.extend(self._make_twin(cell) for _ in missing)
        else:
            self._gl_thread.run(lambda _: twins.append(self._make_twin(cell)), missing)
        return twins


def mesh_cell(camera: Camera) -> float:
    """Half a pixel at a camera's target, in whole millimetres [m]; 0: all details."""
    pixel = 2 * camera.distance * math.tan(math.radians(camera.fov) / 2) / camera.height
    cell = round(pixel / 2, 3)
    return cell if cell >= _FINEST_CELL else 0.0
