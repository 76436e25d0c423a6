"""Pictures of several environments, and blending of layers."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from torch_panda.rendering.camera import Camera


class Frames(NamedTuple):
    """Pictures of n environments.

    Attributes:
        pixels: (n, height, width, 3) uint8.
        depth: (n, height, width, 1) float32 [m]; None if it is not drawn.
        segmentation: (n, height, width, 1) int32, body ids; None if it is not drawn.
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
