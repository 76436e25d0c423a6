"""What an environment can observe beyond the state of robot and task."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor
from torchrl.data import TensorSpec

from torch_panda.bullet import Camera, VectorSimulation
from torch_panda.bullet.camera import resized
from torch_panda.bullet.renderers import RendererName, check_renderer
from torch_panda.envs.renderer import Renderer
from torch_panda.envs.touch import Touch, check_sensors
from torch_panda.envs.vision import PIXELS_CAMERA, Vision
from torch_panda.robots import Robot


class Sense(Protocol):
    """A source of observations."""

    def spec(self, batch: torch.Size, device: torch.device) -> dict[str, TensorSpec]:
        """What `observe` gives, for a batch size."""

    def after_reset(self, envs: Sequence[int]) -> None:
        """Episodes have started in these environments."""

    def after_step(self, envs: Sequence[int]) -> None:
        """Time has passed in these environments."""

    def observe(self) -> dict[str, Tensor]:
        """What is sensed now in all n environments: (n, ...), in new tensors."""


@dataclass(frozen=True)
class SenseOptions:
    """Which senses an environment has; see `RobotTaskEnv` for the options."""

    from_pixels: bool
    pixels_only: bool
    camera: Camera | None
    render_size: int | tuple[int, int] | None
    depth: bool
    segmentation: bool
    renderer: RendererName
    sensors: Sequence[str]

    @property
    def sees(self) -> bool:
        """Whether pictures are observed."""
        return self.from_pixels or self.depth or self.segmentation

    def check(self, robot: Robot) -> None:
        """Make sure that a robot on this machine can have these senses.

        Raises:
            ValueError: the options contradict each other, or the robot, or a size is
                out of range.
            RuntimeError: EGL is asked for and does not work here.
        """
        if self.pixels_only and not self.from_pixels:
            raise ValueError("pixels_only=True needs from_pixels=True")
        view = self.camera is not None or self.render_size is not None
        if view and not self.sees:
            raise ValueError(
                "camera and render_size need from_pixels, depth or segmentation"
            )
        resized(self.camera or PIXELS_CAMERA, self.render_size)
        check_renderer(self.renderer)
        check_sensors(robot, self.sensors)

    def make(
        self, simulation: VectorSimulation, renderer: Renderer, robot: Robot
    ) -> list[Sense]:
        """The senses, none of which exists unless it was asked for."""
        senses: list[Sense] = []
        if self.sees:
            vision = Vision(
                renderer,
                simulation.num_envs,
                resized(self.camera or PIXELS_CAMERA, self.render_size),
                pixels=self.from_pixels,
                depth=self.depth,
                segmentation=self.segmentation,
            )
            senses.append(vision)
        if self.sensors:
            senses.append(Touch(simulation, robot, self.sensors))
        return senses
