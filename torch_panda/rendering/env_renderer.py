"""Renders one environment at a time, in a copy of the scene with visual shapes."""

import numpy as np

from torch_panda.bullet import VectorSimulation
from torch_panda.bullet.blueprint import CreateBody
from torch_panda.rendering.camera import Camera, to_metres
from torch_panda.rendering.egl import RendererName
from torch_panda.rendering.frames import Frames, blend
from torch_panda.rendering.visual_client import VisualClient

BACKGROUND = -1  # body id in a segmentation


class EnvRenderer:
    """Draws one environment at a time, in a copy of the scene with visual shapes.

    The physics clients therefore need no visual shapes, and one renderer serves many
    environments. Markers are always drawn by "tiny", also if ``renderer`` is "egl". For
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

    def draw(self, env: int, camera: Camera, frames: Frames, row: int) -> None:
        """Draw an environment in its current state into a row of ``frames``.

        Depth and segmentation contain the robot and the solid bodies only. Markers
        appear only in the pixels, because they show the goal and are not real bodies.
        """
        scene, state = self._simulation.scene, self._simulation.state
        hand = [*state.ee_position[env].tolist(), *state.ee_orientation[env].tolist()]
        self._solids.pose(scene, state, env)
        image = self._solids.draw(
            camera,
            hand,
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
            overlay = self._markers.draw(camera, hand, segmentation=True, shadow=False)
            assert overlay.segmentation is not None
            in_front = overlay.depth < image.depth
            opacity = self._opacity[overlay.segmentation[in_front]]
            blend(pixels, overlay.rgb, in_front, opacity)


def segmentation_ids(simulation: VectorSimulation) -> dict[str, int]:
    """The body ids in segmentations, by name of the body."""
    scene = simulation.scene
    names = {scene.robot: "robot"}
    for k, body in enumerate(scene.objects):
        names[body] = "object" if len(scene.objects) == 1 else f"object{k + 1}"
    for command in simulation.blueprint:
        if isinstance(command, CreateBody) and command.visual.name is not None:
            names[command.body] = command.visual.name
    return {"nothing": BACKGROUND} | {names[body]: body for body in sorted(names)}
