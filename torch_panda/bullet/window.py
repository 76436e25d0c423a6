"""A client whose world pybullet's GUI shows in a window."""

from ctypes import c_char_p, c_float

from torch_panda.bullet import _capi
from torch_panda.bullet.camera import Camera
from torch_panda.bullet.client import BulletError
from torch_panda.bullet.renderers import probe
from torch_panda.bullet.visual import VisualClient

# enum b3ConfigureDebugVisualizerEnum
_COV_ENABLE_GUI = 1  # the panels beside the view
_COV_ENABLE_KEYBOARD_SHORTCUTS = 9
_COV_ENABLE_MOUSE_PICKING = 10

_PROBE = "import pybullet as p; p.connect(p.GUI); p.disconnect()"


class WindowClient(VisualClient):
    """A client that is seen in a window, which a thread of Bullet's own draws.

    With Ctrl or Alt held, the mouse turns and moves the view; its wheel zooms.

    Raises:
        BulletError: there is no display, or no OpenGL on it.
    """

    def __init__(self) -> None:
        _check_display()
        super().__init__("all")
        for flag in (
            _COV_ENABLE_GUI,
            _COV_ENABLE_KEYBOARD_SHORTCUTS,
            _COV_ENABLE_MOUSE_PICKING,
        ):
            command = _capi.window_init(self._open())
            _capi.window_set_flag(command, flag, 0)
            self._submit(
                command, _capi.CMD_CLIENT_COMMAND_COMPLETED, "configure its window"
            )

    def look(self, camera: Camera) -> None:
        """See the world from a camera; roll, field of view and size are not used."""
        command = _capi.window_init(self._open())
        _capi.window_set_camera(
            command,
            camera.distance,
            camera.pitch,
            camera.yaw,
            (c_float * 3)(*camera.target),
        )
        self._submit(command, _capi.CMD_CLIENT_COMMAND_COMPLETED, "move its camera")

    def _connect(self) -> int | None:
        arguments = (c_char_p * 1)(b"--unused")
        handle: int | None = _capi.connect_window(len(arguments), arguments)
        return handle


def _check_display() -> None:
    """In a process of its own: where there is no display, Bullet ends the process."""
    if complaint := probe(_PROBE):
        raise BulletError(
            f"Bullet could not open a window, which needs a display with OpenGL "
            f"(it said: {complaint})"
        )
