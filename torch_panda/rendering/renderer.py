"""Renders environments: many in parallel, each in a copy of the scene."""

import math
import threading
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from torch_panda.bullet import VectorSimulation, WorkerPool
from torch_panda.bullet.blueprint import CreateBody, LoadURDF
from torch_panda.rendering.camera import Camera, to_metres
from torch_panda.rendering.egl import RendererName
from torch_panda.rendering.visual_client import VisualClient

BACKGROUND = -1  # body id in a segmentation

# Mesh cells of renderers [m]. They are few, because each has copies of the scene. Finer
# ones would not save time.
_MESH_CELLS = (0.004, 0.006, 0.009, 0.0125, 0.025, 0.05)


class Frames(NamedTuple):
    """Pictures of n environments.

    Attributes:
        pixels: (n, height, width, 3) uint8.
        depth: (n, height, width, 1) float32 [m]; None if it is not rendered.
        segmentation: (n, height, width, 1) int32, body ids; None if it is not rendered.
    """

    pixels: Tensor
    depth: Tensor | None = None
    segmentation: Tensor | None = None

    @classmethod
    def allocate(
        cls, n: int, camera: Camera, *, depth: bool = False, segmentation: bool = False
    ) -> "Frames":
        """Allocate n black pictures of a camera's size."""

        def zeros(channels: int, dtype: torch.dtype) -> Tensor:
            shape = (n, camera.height, camera.width, channels)
            return torch.zeros(shape, dtype=dtype, device="cpu")

        return cls(
            zeros(3, torch.uint8),
            zeros(1, torch.float32) if depth else None,
            zeros(1, torch.int32) if segmentation else None,
        )


class VectorRenderer:
    """Renders the environments of a simulation in parallel.

    Each thread uses an `EnvRenderer` of its own. The first picture builds the renderers
    that it needs. For small pictures, the robot's meshes are coarsened to cells of at
    most half a pixel (see `mesh_cell`).

    Args:
        simulation: The simulation whose environments are rendered. Its threads also
            render.
        renderer: "tiny", Bullet's software renderer, or "egl", its OpenGL renderer.
            "egl" renders in one separate thread, because an OpenGL context belongs to
            one thread.
    """

    def __init__(self, simulation: VectorSimulation, *, renderer: RendererName) -> None:
        self._simulation = simulation
        self._renderer: RendererName = renderer
        # Idle renderers by mesh cell. Threads share these lists without a lock, because
        # the GIL makes `pop` and `append` atomic.
        self._idle: dict[float, list[EnvRenderer]] = {}
        self._gl_thread = WorkerPool(1) if renderer == "egl" else None

    def render(self, envs: Sequence[int], camera: Camera) -> Tensor:
        """Render environments: (len(envs), height, width, 3) uint8.

        Raises:
            WorkerError: Bullet failed in at least one picture.
        """
        frames = Frames.allocate(len(envs), camera)
        self.render_into(frames, range(len(envs)), envs, camera)
        return frames.pixels

    def render_into(
        self, frames: Frames, rows: Sequence[int], envs: Sequence[int], camera: Camera
    ) -> None:
        """Render environments into rows of ``frames``; see `EnvRenderer.render_into`.

        Raises:
            WorkerError: Bullet failed in at least one picture.
        """
        jobs = list(zip(envs, rows, strict=True))
        run = self._simulation.run if self._gl_thread is None else self._gl_thread.run
        cell = mesh_cell(camera) if self._gl_thread is None else 0.0
        threads = self._simulation.num_threads if self._gl_thread is None else 1
        renderers = self._provide(cell, min(threads, len(jobs)))

        def render_job(job: int) -> None:
            env, row = jobs[job]
            renderer = renderers.pop()
            try:
                renderer.render_into(frames, row, env, camera)
            finally:
                renderers.append(renderer)

        run(render_job, range(len(jobs)))

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


class EnvRenderer:
    """Renders one environment at a time, in a copy of the scene with visual shapes.

    The physics clients therefore need no visual shapes, and one renderer serves many
    environments. "tiny" always renders the markers, also if ``renderer`` is "egl". For
    ``renderer`` and ``mesh_cell``, see `VisualClient`.
    """

    def __init__(
        self,
        simulation: VectorSimulation,
        *,
        renderer: RendererName,
        mesh_cell: float,
    ) -> None:
        self._simulation = simulation
        blueprint = simulation.blueprint
        opacity = {
            command.body: command.visual.opacity
            for command in blueprint
            if isinstance(command, CreateBody) and command.is_marker
        }
        self._solids = VisualClient(
            blueprint, "solids", renderer=renderer, mesh_cell=mesh_cell
        )
        self._markers: VisualClient | None = None
        if opacity:
            try:
                self._markers = VisualClient(blueprint, "markers")
            except BaseException:
                self.close()
                raise
            self._opacity = np.zeros(max(opacity) + 1, dtype=np.float32)
            self._opacity[list(opacity)] = list(opacity.values())

    def close(self) -> None:
        """Free the clients. Closing again does nothing."""
        self._solids.close()
        if self._markers is not None:
            self._markers.close()

    def render_into(self, frames: Frames, row: int, env: int, camera: Camera) -> None:
        """Render an environment in its current state into a row of ``frames``.

        Depth and segmentation contain the robot and the solid bodies only. Markers
        appear only in the pixels, because they show the goal and are not real bodies.
        """
        scene, state = self._simulation.scene, self._simulation.state
        ee_pose = [
            *state.ee_position[env].tolist(),
            *state.ee_orientation[env].tolist(),
        ]
        self._solids.pose(scene, state, env)
        image = self._solids.render(
            camera,
            ee_pose,
            segmentation=frames.segmentation is not None,
            shadow=camera.shadows,
        )
        pixels = frames.pixels[row].numpy()
        pixels[:] = image.rgb
        if frames.depth is not None:
            frames.depth[row].numpy()[..., 0] = to_metres(image.depth, camera)
        if frames.segmentation is not None:
            frames.segmentation[row].numpy()[..., 0] = image.segmentation
        if self._markers is not None:
            self._markers.pose(scene, state, env)
            overlay = self._markers.render(
                camera, ee_pose, segmentation=True, shadow=False
            )
            assert overlay.segmentation is not None
            in_front = overlay.depth < image.depth
            opacity = self._opacity[overlay.segmentation[in_front]]
            blend(pixels, overlay.rgb, in_front, opacity)


def blend(
    pixels: npt.NDArray[np.uint8],
    overlay: npt.NDArray[np.uint8],
    where: npt.NDArray[np.bool_],
    opacity: npt.NDArray[np.float32],
) -> None:
    """Blend a translucent layer over a picture, in place.

    Args:
        pixels: Picture (height, width, 3), which is changed.
        overlay: Translucent layer in front of it (height, width, 3).
        where: Mask of the pixels that the layer covers (height, width).
        opacity: Opacities of the covered pixels, in row-major order.
    """
    opacity = opacity[:, None]
    mixed = (1 - opacity) * pixels[where] + opacity * overlay[where]
    pixels[where] = mixed.round().astype(np.uint8)


def mesh_cell(camera: Camera) -> float:
    """Mesh cell that suits a camera's pictures [m].

    It is the largest of `_MESH_CELLS` that is at most half the size of a pixel at the
    camera's target. If there is none, the result is 0, which renders all details.
    """
    pixel = 2 * camera.distance * math.tan(math.radians(camera.fov) / 2) / camera.height
    return max((cell for cell in _MESH_CELLS if cell <= pixel / 2), default=0.0)


def segmentation_ids(simulation: VectorSimulation) -> dict[str, int]:
    """The body ids in segmentations, by name; see `RobotTaskEnv.segmentation_ids`."""
    scene = simulation.scene
    roles = {scene.robot: "robot"}
    for k, body in enumerate(scene.objects):
        roles[body] = "object" if len(scene.objects) == 1 else f"object{k + 1}"
    names: dict[int, str] = {}
    for command in simulation.blueprint:
        match command:
            case CreateBody(body, is_marker=False, visual=visual):
                names[body] = visual.name or roles.get(body, f"body{body}")
            case LoadURDF(body):
                names[body] = roles.get(body, f"body{body}")
    ids = {"nothing": BACKGROUND}
    for body, name in names.items():
        equal = [other for other in names if names[other] == name]
        ids[f"{name}{equal.index(body) + 1}" if len(equal) > 1 else name] = body
    return ids
