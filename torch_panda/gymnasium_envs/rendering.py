"""Render modes of Gymnasium, and camera arguments of panda-gym."""

import dataclasses
from typing import Any

from torch_panda.checks import check_instance, check_vector
from torch_panda.rendering import Camera

RENDER_MODES = ("rgb_array",)

CAMERA_FIELDS = {
    "render_width": "width",
    "render_height": "height",
    "render_target_position": "target",
    "render_distance": "distance",
    "render_yaw": "yaw",
    "render_pitch": "pitch",
    "render_roll": "roll",
}
"""Fields of `Camera`, by the names of panda-gym's arguments."""


def check_render_mode(render_mode: str | None) -> None:
    """Check a render mode.

    Raises:
        ValueError: The render mode is unknown.
    """
    if render_mode is not None and render_mode not in RENDER_MODES:
        raise ValueError(
            f"render_mode must be None or one of {RENDER_MODES}, got {render_mode!r}; "
            "for a window call open_window() or open_viewer() of env.torch_env"
        )


def take_camera(camera: Camera | None, arguments: dict[str, Any]) -> Camera | None:
    """Change a camera by panda-gym's camera arguments.

    Args:
        camera: The camera; None means a `Camera` with panda-gym's defaults.
        arguments: Keyword arguments of a Gymnasium environment. The call removes
            panda-gym's camera arguments from this dict.

    Returns:
        The changed camera, or ``camera`` itself if there are no such arguments.

    Raises:
        ValueError: A camera argument is out of range.
        TypeError: ``camera`` is not a `Camera`.
    """
    if camera is not None:
        check_instance("render_camera", camera, Camera)
    changes = {
        field: arguments.pop(name)
        for name, field in CAMERA_FIELDS.items()
        if name in arguments
    }
    if "target" in changes:
        target = check_vector("render_target_position", changes["target"])
        changes["target"] = target
    return dataclasses.replace(camera or Camera(), **changes) if changes else camera
