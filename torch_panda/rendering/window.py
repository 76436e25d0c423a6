"""A window in which one environment after the other can be watched."""

from collections.abc import Callable
from ctypes import c_char_p, c_float

from typing_extensions import Self

from torch_panda.bullet import (
    BulletError,
    PhysicsClient,
    Scene,
    VectorSimulation,
    capi,
)
from torch_panda.rendering.camera import Camera
from torch_panda.rendering.egl import probe
from torch_panda.rendering.scene_renderer import pose_bodies, pose_solids
from torch_panda.rendering.visual_client import VisualClient

# enum b3ConfigureDebugVisualizerEnum
_COV_ENABLE_GUI = 1  # the panels beside the view
_COV_ENABLE_KEYBOARD_SHORTCUTS = 9
_COV_ENABLE_MOUSE_PICKING = 10

_PROBE = "import pybullet as p; p.connect(p.GUI); p.disconnect()"


class WindowClient(VisualClient):
    """A client that is seen in pybullet's GUI, which a thread of Bullet's own draws.

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
            command = capi.window_init(self._open())
            capi.window_set_flag(command, flag, 0)
            self._submit(
                command, capi.CMD_CLIENT_COMMAND_COMPLETED, "configure its window"
            )

    def move_camera(self, camera: Camera) -> None:
        """See the world from a camera; roll, field of view and size are not used."""
        command = capi.window_init(self._open())
        capi.window_set_camera(
            command,
            camera.distance,
            camera.pitch,
            camera.yaw,
            (c_float * 3)(*camera.target),
        )
        self._submit(command, capi.CMD_CLIENT_COMMAND_COMPLETED, "move its camera")

    def _connect(self) -> int | None:
        arguments = (c_char_p * 1)(b"--unused")
        handle: int | None = capi.connect_window(len(arguments), arguments)
        return handle


class Window:
    """pybullet's GUI on a copy of the scene; see `RobotTaskEnv.open_window`.

    Args:
        simulation: whose state is shown.
        build_scene: builds robot and task in a client.
        camera: where the view starts; the mouse moves it.

    Raises:
        BulletError: there is no display, or no OpenGL on it.
    """

    def __init__(
        self,
        simulation: VectorSimulation,
        build_scene: Callable[[PhysicsClient], Scene],
        camera: Camera,
    ) -> None:
        self._simulation = simulation
        self._client = WindowClient()
        try:
            self._scene = build_scene(self._client)
            simulation.check_same(self._client, self._scene)
            self._client.move_camera(camera)
        except BaseException:
            self.close()
            raise

    def show(self, env: int = 0) -> None:
        """Show an environment, by its index, as it is now.

        Raises:
            BulletError: the window is closed.
        """
        simulation = self._simulation
        pose_solids(self._client, self._scene, simulation, env)
        pose_bodies(self._client, self._scene.markers, simulation.marker_pose[env])

    def close(self) -> None:
        """Close the window. Closing again does nothing."""
        self._client.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def _check_display() -> None:
    """In a process of its own: where there is no display, Bullet ends the process."""
    if complaint := probe(_PROBE):
        raise BulletError(
            f"Bullet could not open a window, which needs a display with OpenGL "
            f"(it said: {complaint})"
        )
