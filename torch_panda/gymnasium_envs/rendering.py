"""Render modes of Gymnasium, and camera arguments of panda-gym."""

import dataclasses
from typing import Any

from torch_panda.rendering import Camera

RENDER_MODES = ("rgb_array",)

# Fields of `Camera`, by the names of panda-gym's arguments.
_CAMERA_FIELDS = {
    "render_width": "width",
    "render_height": "height",
    "render_target_position": "target",
    "render_distance": "distance",
    "render_yaw": "yaw",
    "render_pitch": "pitch",
    "render_roll": "roll",
}


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


def take_camera(
    camera: Camera | None, arguments: dict[str, Any]
) -> tuple[Camera | None, dict[str, Any]]:
    """Separate the camera arguments of panda-gym from other arguments.

    Args:
        camera: The camera that these arguments change; None means a `Camera` with
            panda-gym's defaults.
        arguments: Keyword arguments of a Gymnasium environment.

    Returns:
        The changed camera, or ``camera`` itself if there are no such arguments; and the
        other arguments.

    Raises:
        ValueError: A camera argument is out of range.
    """
    changes = {
        _CAMERA_FIELDS[name]: value
        for name, value in arguments.items()
        if name in _CAMERA_FIELDS
    }
    if "target" in changes:
        x, y, z = changes["target"]
        changes["target"] = (float(x), float(y), float(z))
    others = {
        name: value for name, value in arguments.items() if name not in _CAMERA_FIELDS
    }
    if changes:
        camera = dataclasses.replace(camera or Camera(), **changes)
    return camera, others
