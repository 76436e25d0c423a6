"""Pictures of environments: cameras, renderers and a window."""

from torch_panda.rendering.camera import Camera, HandCamera
from torch_panda.rendering.egl import RendererName, check_renderer
from torch_panda.rendering.env_renderer import segmentation_ids
from torch_panda.rendering.vector_renderer import VectorRenderer
from torch_panda.rendering.window import Window

__all__ = [
    "Camera",
    "HandCamera",
    "RendererName",
    "VectorRenderer",
    "Window",
    "check_renderer",
    "segmentation_ids",
]
