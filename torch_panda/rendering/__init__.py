"""Pictures of environments: cameras and renderers."""

from torch_panda.rendering.camera import Camera, HandCamera
from torch_panda.rendering.egl import RendererName, check_renderer
from torch_panda.rendering.renderer import VectorRenderer

__all__ = [
    "Camera",
    "HandCamera",
    "RendererName",
    "VectorRenderer",
    "check_renderer",
]
