"""Gymnasium's render modes, and panda-gym's names for the camera."""

import dataclasses
from typing import Any

from torch_panda.rendering import Camera

RENDER_MODES = ("rgb_array",)

# panda-gym's keywords, and the fields of a camera.
_CAMERA = {
    "render_width": "width",
    "render_height": "height",
    "render_target_position": "target",
    "render_distance": "distance",
    "render_yaw": "yaw",
    "render_pitch": "pitch",
    "render_roll": "roll",
}


def check_render_mode(render_mode: str | None) -> None:
    """Make sure that there is such a render mode.

    Raises:
        ValueError: there is not.
    """
    if render_mode is not None and render_mode not in RENDER_MODES:
        raise ValueError(
            f"render_mode must be None or one of {RENDER_MODES}, got {render_mode!r}; "
            "examples/watch.py --human and open_window() of the torch environment "
            "show a window"
        )


def take_camera(
    camera: Camera | None, arguments: dict[str, Any]
) -> tuple[Camera | None, dict[str, Any]]:
    """The camera of some keyword arguments, and the arguments that are left.

    Args:
        camera: what panda-gym's keywords change; None means panda-gym's own.
        arguments: ``render_width``, ``render_height``, ``render_target_position``,
            ``render_distance``, ``render_yaw``, ``render_pitch`` and ``render_roll``
            among others.

    Raises:
        ValueError: a value is out of range.
    """
    changes = {
        _CAMERA[name]: value for name, value in arguments.items() if name in _CAMERA
    }
    if "target" in changes:
        x, y, z = changes["target"]
        changes["target"] = (float(x), float(y), float(z))
    rest = {name: value for name, value in arguments.items() if name not in _CAMERA}
    if changes:
        camera = dataclasses.replace(camera or Camera(), **changes)
    return camera, rest
