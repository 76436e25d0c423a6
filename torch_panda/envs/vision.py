"""Cameras as observations."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torchrl.data import Bounded, TensorSpec, Unbounded

from torch_panda.bullet import Camera
from torch_panda.envs.renderer import Renderer
from torch_panda.envs.twin import Frames

# panda-gym's view, in a size to learn from.
PIXELS_CAMERA = Camera(width=64, height=64)


class Vision:
    """Pictures of all environments, drawn after every reset and step.

    Args:
        renderer: draws the environments.
        num_envs: how many there are.
        camera: the same for all.
        pixels: whether to observe ``pixels``, (height, width, 3) uint8.
        depth: whether to observe ``depth``, (height, width, 1) float32: the distance
            along the line of sight [m], ``camera.far`` where nothing is.
        segmentation: whether to observe ``segmentation``, (height, width, 1) int32:
            the body ids that `segmentation_ids` names, -1 where nothing is.
    """

    def __init__(
        self,
        renderer: Renderer,
        num_envs: int,
        camera: Camera,
        *,
        pixels: bool,
        depth: bool,
        segmentation: bool,
    ) -> None:
        self._renderer = renderer
        self._camera = camera
        self._pixels = pixels
        self._frames = Frames.allocate(
            num_envs, camera, depth=depth, segmentation=segmentation
        )

    def spec(self, batch: torch.Size, device: torch.device) -> dict[str, TensorSpec]:
        """Specs of what is observed."""
        size = (*batch, self._camera.height, self._camera.width)
        specs: dict[str, TensorSpec] = {}
        if self._pixels:
            specs["pixels"] = Bounded(
                0, 255, (*size, 3), dtype=torch.uint8, device=device
            )
        if self._frames.depth is not None:
            specs["depth"] = Bounded(
                0.0, self._camera.far, (*size, 1), dtype=torch.float32, device=device
            )
        if self._frames.segmentation is not None:
            specs["segmentation"] = Unbounded(
                (*size, 1), dtype=torch.int32, device=device
            )
        return specs

    def after_reset(self, envs: Sequence[int]) -> None:
        """Draw these environments."""
        self._renderer.draw(envs, self._camera, self._frames, envs)

    def after_step(self, envs: Sequence[int]) -> None:
        """Draw these environments."""
        self._renderer.draw(envs, self._camera, self._frames, envs)

    def observe(self) -> dict[str, Tensor]:
        """The latest pictures of all environments."""
        frames = self._frames
        pictures = {
            "pixels": frames.pixels if self._pixels else None,
            "depth": frames.depth,
            "segmentation": frames.segmentation,
        }
        return {key: p.clone() for key, p in pictures.items() if p is not None}
