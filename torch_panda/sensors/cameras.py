"""Cameras as sensors."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_panda.bullet import VectorSimulation
from torch_panda.rendering import Camera, VectorRenderer
from torch_panda.rendering.frames import Frames
from torch_panda.robots import Robot
from torch_panda.sensors.base import Entry, Reading, Sensor

PIXELS_CAMERA = Camera(width=64, height=64)


@dataclass(frozen=True)
class CameraSensor(Sensor):
    """A camera that sees every environment after every reset and step.

    Attributes:
        camera: the same for all; by default panda-gym's view, in a size to learn from.
        pixels: observe ``pixels``, (height, width, 3) uint8.
        depth: observe ``depth``, (height, width, 1) float32: the distance along the
            line of sight [m], ``camera.far`` where nothing is.
        segmentation: observe ``segmentation``, (height, width, 1) int32: the body ids
            that `segmentation_ids` names, -1 where nothing is.
        name: of the camera, where there are several: ``wrist`` observes
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
        """See all environments of a simulation."""
        return _Pictures(self, simulation.num_envs, renderer)


class _Pictures:
    """The latest pictures of n environments."""

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
        found: dict[str, Entry] = {}
        if sensor.pixels:
            found["pixels"] = Entry((*size, 3), torch.uint8, high=255)
        if sensor.depth:
            found["depth"] = Entry((*size, 1), torch.float32, high=sensor.camera.far)
        if sensor.segmentation:
            found["segmentation"] = Entry((*size, 1), torch.int32)
        prefix = "" if sensor.name is None else f"{sensor.name}_"
        self._sources = {prefix + key: key for key in found}
        self.entries = {prefix + key: entry for key, entry in found.items()}

    def after_reset(self, envs: Sequence[int]) -> None:
        """Draw these environments."""
        self._renderer.draw(envs, self._camera, self._frames, envs)

    def after_step(self, envs: Sequence[int]) -> None:
        """Draw these environments."""
        self._renderer.draw(envs, self._camera, self._frames, envs)

    def observe(self) -> dict[str, Tensor]:
        """The latest pictures of all environments."""
        return {
            key: getattr(self._frames, source).clone()
            for key, source in self._sources.items()
        }
