"""Drawing many environments in parallel."""

from collections.abc import Callable, Sequence

from torch_panda.bullet import Camera, VectorSimulation, WorkerPool
from torch_panda.bullet.visual import RendererName, check_egl
from torch_panda.envs.twin import Frames, VisualTwin


class Renderer:
    """Draws the environments of a simulation, each thread with a visual twin.

    Nothing is built before something is drawn.

    Args:
        simulation: what is drawn, by its own threads.
        make_twin: makes a twin of its scene.
        renderer: "tiny": Bullet's software renderer; "egl": its OpenGL renderer, in
            one thread of its own, because a context of OpenGL belongs to a thread.

    Raises:
        RuntimeError: EGL is asked for and does not work here.
    """

    def __init__(
        self,
        simulation: VectorSimulation,
        make_twin: Callable[[], VisualTwin],
        *,
        renderer: RendererName = "tiny",
    ) -> None:
        self._simulation = simulation
        self._make_twin = make_twin
        # Idle twins; taking from and adding to a list are atomic under the GIL.
        self._twins: list[VisualTwin] = []
        self._gl_thread: WorkerPool | None = None
        if renderer == "egl":
            check_egl()
            self._gl_thread = WorkerPool(1)

    @property
    def segmentation_ids(self) -> dict[str, int]:
        """What the numbers in segmentations stand for."""
        self._make_twins(1)
        return self._twins[0].segmentation_ids

    def draw(
        self, envs: Sequence[int], camera: Camera, frames: Frames, rows: Sequence[int]
    ) -> None:
        """Draw environments into rows of ``frames``; see `VisualTwin.draw`.

        Raises:
            WorkerError: Bullet failed in one twin.
        """
        row_of = dict(zip(envs, rows, strict=True))

        def work(env: int) -> None:
            twin = self._twins.pop()
            try:
                twin.draw(self._simulation, env, camera, frames, row_of[env])
            finally:
                self._twins.append(twin)

        if self._gl_thread is not None:
            self._make_twins(1)
            self._gl_thread.run(work, envs)
        else:
            self._make_twins(min(self._simulation.num_threads, len(envs)))
            self._simulation.run(work, envs)

    def close(self) -> None:
        """Free all twins. Closing again does nothing."""
        twins, self._twins = self._twins, []
        if self._gl_thread is None:
            for twin in twins:
                twin.close()
        else:
            self._gl_thread.run(lambda k: twins[k].close(), range(len(twins)))
            self._gl_thread.close()

    def _make_twins(self, count: int) -> None:
        """Have that many, made one by one: Bullet's importer is not for threads."""
        missing = range(len(self._twins), count)
        if self._gl_thread is None:
            for _ in missing:
                self._twins.append(self._make_twin())
        else:
            self._gl_thread.run(
                lambda _: self._twins.append(self._make_twin()), missing
            )
