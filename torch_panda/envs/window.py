"""A window in which one environment after the other can be watched."""

from collections.abc import Callable

from torch_panda.bullet import Camera, PhysicsClient, Scene, VectorSimulation
from torch_panda.bullet.window import WindowClient
from torch_panda.closing import Closing
from torch_panda.envs.twin import pose_bodies, pose_solids


class Window(Closing):
    """pybullet's GUI on a visual twin; see `RobotTaskEnv.open_window`.

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
            self._client.look(camera)
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
        pose_bodies(self._client, self._scene.targets, simulation.target_pose[env])

    def close(self) -> None:
        """Close the window. Closing again does nothing."""
        self._client.close()
