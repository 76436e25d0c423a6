"""Pictures, windows and pages that show an environment."""

import functools
from collections.abc import Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torch_panda.envs.episodes import Episodes
from torch_panda.rendering import Camera, Window, segmentation_ids
from torch_panda.rendering.camera import resized

if TYPE_CHECKING:  # needs an extra
    from torch_panda.rendering.web_viewer import WebViewer


class PicturedEnv:
    """What of an environment is for the eye.

    Attributes:
        episodes: what is drawn.
        num_envs: number of environments; None: one, of batch size [].
        device: where pictures are placed.
    """

    episodes: Episodes
    num_envs: int | None
    device: torch.device

    @functools.cached_property
    def segmentation_ids(self) -> dict[str, int]:
        """What the numbers in segmentations stand for, by name.

        ``nothing`` (-1), ``robot``, ``ground``, ``table``, and ``object``, or
        ``object1`` and ``object2``, unless the task's visuals name bodies otherwise.
        """
        return segmentation_ids(self.episodes.build_scene)

    def render(
        self,
        envs: int | Sequence[int] | None = None,
        *,
        camera: Camera | None = None,
        size: int | tuple[int, int] | None = None,
    ) -> Tensor:
        """Draw the environments as they are now.

        Args:
            envs: which, by index; None means all.
            camera: where from; None means `Camera`'s defaults, which are panda-gym's.
            size: height and width of the picture [pixels], or both in one number;
                None means the camera's.

        Returns:
            uint8, (num_envs, height, width, 3) or as many as were asked for;
            (height, width, 3) for one index or an environment of batch size [].

        Raises:
            BulletError: the environment is closed, or another thread is in it.
            ValueError: an index is out of range, or its environment was never reset.
            TypeError: an index is no integer.
        """
        camera, episodes = resized(camera or Camera(), size), self.episodes
        if envs is None:
            chosen, single = range(episodes.num_envs), self.num_envs is None
        else:
            chosen, single = np.atleast_1d(envs).tolist(), np.ndim(envs) == 0
        with episodes.held():
            for env in chosen:
                episodes.check_picture(env)
            pixels = episodes.renderer.picture(chosen, camera).to(self.device)
        return pixels[0] if single else pixels

    def open_window(self, camera: Camera | None = None) -> Window:
        """Open pybullet's GUI: ``show(i)`` of the result shows environment i.

        It needs a display. Close it, or use it under ``with``.

        Args:
            camera: where the view starts; None means `Camera`'s defaults.

        Raises:
            BulletError: there is no display, or the environment is closed.
        """
        episodes = self.episodes
        with episodes.held():
            return Window(episodes.simulation, episodes.build_scene, camera or Camera())

    def open_viewer(
        self,
        camera: Camera | None = None,
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
    ) -> "WebViewer":
        """Serve the scene to browsers, in three dimensions; needs the extra ``viewer``.

        Call ``update()`` of the result after each reset and step: the page then shows
        them, and its slider goes back over the episode. Close it, or use it under
        ``with``.

        Args:
            camera: where the view starts; None means `Camera`'s defaults.
            host: the address at which it serves; "0.0.0.0" lets other machines in.
            port: or, if it is taken, the next one that is free; see ``url``.

        Raises:
            ImportError: viser is not installed.
            BulletError: the environment is closed.
        """
        if find_spec("viser") is None:
            raise ImportError(
                "viewers need viser: pip install -c .ci/constraints.txt -e '.[viewer]'"
            )
        from torch_panda.rendering.web_viewer import WebViewer

        episodes = self.episodes
        with episodes.held():
            return WebViewer(
                episodes.simulation,
                episodes.watch,
                max_episode_steps=episodes.max_episode_steps,
                title=type(episodes.task).__name__,
                camera=camera or Camera(),
                host=host,
                port=port,
            )
