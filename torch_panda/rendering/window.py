"""A window of pybullet's GUI that shows one environment."""

from ctypes import c_char_p, c_float

from typing_extensions import Self

from torch_panda.bullet import VectorSimulation, capi
from torch_panda.bullet.connection import BulletError, Connection
from torch_panda.checks import check_instance
from torch_panda.rendering.camera import Camera
from torch_panda.rendering.egl import probe
from torch_panda.rendering.visual_client import VisualClient

# enum b3ConfigureDebugVisualizerEnum
_COV_ENABLE_GUI = 1  # the panels at the sides of the window
_COV_ENABLE_KEYBOARD_SHORTCUTS = 9
_COV_ENABLE_MOUSE_PICKING = 10

_PROBE = "import pybullet as p; p.connect(p.GUI); p.disconnect()"


class Window:
    """pybullet's GUI on a copy of the scene; see `RobotTaskEnv.open_window`.

    A thread of Bullet draws the window. Dragging the mouse with Ctrl or Alt held turns
    and moves the view, and the mouse wheel zooms.

    Args:
        simulation: The simulation whose state is shown.
        camera: Camera with which the view starts. Its ``roll``, ``fov``, ``width`` and
            ``height`` are not used.

    Raises:
        BulletError: There is no display, or no OpenGL on it.
    """

    def __init__(self, simulation: VectorSimulation, camera: Camera) -> None:
        check_instance("camera", camera, Camera)
        _check_display()
        self._simulation = simulation
        arguments = (c_char_p * 1)(b"--unused")
        self._connection = Connection(capi.connect_window(len(arguments), arguments))
        try:
            self._configure(camera)
            self._client = VisualClient(
                simulation.blueprint, "all", connection=self._connection
            )
        except BaseException:
            self.close()
            raise

    def show(self, env: int = 0) -> None:
        """Show an environment in its current state.

        Raises:
            BulletError: The window is closed.
        """
        self._client.pose(self._simulation.scene, self._simulation.state, env)

    def close(self) -> None:
        """Close the window. Closing again does nothing."""
        self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _configure(self, camera: Camera) -> None:
        """Move the camera and hide the panels beside the view."""
        command = capi.window_init(self._connection.handle)
        capi.window_set_camera(
            command,
            camera.distance,
            camera.pitch,
            camera.yaw,
            (c_float * 3)(*camera.target),
        )
        self._run(command, "move its camera")
        for flag in (
            _COV_ENABLE_GUI,
            _COV_ENABLE_KEYBOARD_SHORTCUTS,
            _COV_ENABLE_MOUSE_PICKING,
        ):
            command = capi.window_init(self._connection.handle)
            capi.window_set_flag(command, flag, 0)
            self._run(command, "configure its window")

    def _run(self, command: int, action: str) -> None:
        self._connection.submit(command, capi.CMD_CLIENT_COMMAND_COMPLETED, action)


def _check_display() -> None:
    # Try it in another process, because Bullet ends its process if there is no display.
    if reason := probe(_PROBE):
        raise BulletError(
            f"Bullet could not open a window: a window needs a display with OpenGL "
            f"({reason}). Without a display, use env.open_viewer()"
        )
