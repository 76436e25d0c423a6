"""Cameras as sensors."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_panda.bullet import VectorSimulation
from torch_panda.rendering import Camera, VectorRenderer
from torch_panda.rendering.renderer import Frames
from torch_panda.robots import Robot
from torch_panda.sensors.base import Entry, Reading, Sensor

PIXELS_CAMERA = Camera(width=64, height=64)


@dataclass(frozen=True)
class CameraSensor(Sensor):
    """A camera that takes a picture of every environment after each reset and step.

    Attributes:
        camera: View and size, the same in all environments. The default is panda-gym's
            view in 64 x 64 pixels.
        pixels: Observe ``pixels``, (height, width, 3) uint8.
        depth: Observe ``depth``, (height, width, 1) float32: the distance from the
            camera along its optical axis [m] (z-depth, not the length of a ray), or
            ``camera.far`` where there is nothing.
        segmentation: Observe ``segmentation``, (height, width, 1) int32: the body ids
            that ``segmentation_ids`` names, or -1 where there is nothing.
        name: Name of the camera if there are several. The name "wrist" observes
            ``wrist_pixels``, ``wrist_depth`` and ``wrist_segmentation``.
    """

    camera: Camera = PIXELS_CAMERA
    pixels: bool = True
    depth: bool = False
    segmentation: bool = False
    name: str | None = None

    def attach(
        self, simulation: VectorSimulation, renderer: VectorRenderer, robot: Robot
    ) -> Reading:
        """Take pictures of all environments."""
        return _CameraReading(self, simulation.num_envs, renderer)


class _CameraReading:
    """The latest pictures of all environments."""

    def __init__(
        self, sensor: CameraSensor, num_envs: int, renderer: VectorRenderer
    ) -> None:
        self._renderer = renderer
        self._camera = sensor.camera
        self._frames = Frames.allocate(
            num_envs,
            sensor.camera,
            depth=sensor.depth,
            segmentation=sensor.segmentation,
        )
        size = (sensor.camera.height, sensor.camera.width)
        images: dict[str, Entry] = {}
        if sensor.pixels:
            images["pixels"] = Entry((*size, 3), torch.uint8, high=255)
        if sensor.depth:
            images["depth"] = Entry((*size, 1), torch.float32, high=sensor.camera.far)
        if sensor.segmentation:
            images["segmentation"] = Entry((*size, 1), torch.int32)
        prefix = "" if sensor.name is None else f"{sensor.name}_"
        self._image_of_key = {prefix + image: image for image in images}
        self.entries = {prefix + image: entry for image, entry in images.items()}

    def after_reset(self, envs: Sequence[int]) -> None:
        self._renderer.render_into(self._frames, envs, envs, self._camera)

    after_step = after_reset

    def observe(self) -> dict[str, Tensor]:
        return {
            key: getattr(self._frames, image).clone()
            for key, image in self._image_of_key.items()
        }
