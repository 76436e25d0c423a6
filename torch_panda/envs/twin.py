"""A visual twin: a copy of the scene that is drawn instead of the physics."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from torch_panda.bullet import Camera, PhysicsClient, Scene, VectorSimulation
from torch_panda.bullet.camera import to_metres
from torch_panda.bullet.renderers import RendererName
from torch_panda.bullet.visual import VisualClient

NOTHING = -1  # in a segmentation


@dataclass
class Frames:
    """Pictures of n environments.

    Attributes:
        pixels: (n, height, width, 3) uint8.
        depth: (n, height, width, 1) float32 [m], or None.
        segmentation: (n, height, width, 1) int32, or None.
    """

    pixels: Tensor
    depth: Tensor | None = None
    segmentation: Tensor | None = None

    @classmethod
    def allocate(
        cls, n: int, camera: Camera, *, depth: bool = False, segmentation: bool = False
    ) -> "Frames":
        """Black pictures of a camera's size."""

        def zeros(channels: int, dtype: torch.dtype) -> Tensor:
            shape = (n, camera.height, camera.width, channels)
            return torch.zeros(shape, dtype=dtype, device="cpu")

        return cls(
            zeros(3, torch.uint8),
            zeros(1, torch.float32) if depth else None,
            zeros(1, torch.int32) if segmentation else None,
        )


class VisualTwin:
    """A copy of the scene with visual shapes, which mirrors one environment at a time.

    So that physics clients carry no visual shapes, and one twin draws for many.

    Args:
        build_scene: builds robot and task in a client.
        build_markers: builds the task alone, and returns the body ids of its markers.
        renderer: "tiny" or "egl", what draws the scene.
        mesh_cell: how coarse the robot's meshes are [m]; see `VisualClient`.
    """

    def __init__(
        self,
        build_scene: Callable[[PhysicsClient], Scene],
        build_markers: Callable[[PhysicsClient], tuple[int, ...]],
        *,
        renderer: RendererName = "tiny",
        mesh_cell: float = 0.0,
    ) -> None:
        self._solids = VisualClient("solids", renderer=renderer, mesh_cell=mesh_cell)
        self._markers: VisualClient | None = None
        try:
            self._scene = build_scene(self._solids)
            if self._scene.targets:
                self._markers = VisualClient("markers")
                self._marker_bodies = build_markers(self._markers)
                looks = self._markers.looks
                self._opacity = np.zeros(max(looks) + 1, dtype=np.float32)
                for body, look in looks.items():
                    self._opacity[body] = look.opacity
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Free the clients. Closing again does nothing."""
        self._solids.close()
        if self._markers is not None:
            self._markers.close()

    def draw(
        self,
        simulation: VectorSimulation,
        env: int,
        camera: Camera,
        frames: Frames,
        row: int,
    ) -> None:
        """Draw an environment as the state tensors have it.

        Depth and segmentation are of the robot and the things in the scene. Markers
        are seen in the pixels only: they show what should be, not what is.

        Args:
            simulation: whose state is drawn.
            env: which environment.
            camera: the camera.
            frames: of the camera's size; receives the picture.
            row: where in ``frames``.
        """
        solids, scene = self._solids, self._scene
        pose_solids(solids, scene, simulation, env)
        image = solids.draw(camera, segmentation=frames.segmentation is not None)
        pixels = frames.pixels[row].numpy()
        pixels[:] = image.rgb
        if frames.depth is not None:
            frames.depth[row].numpy()[..., 0] = to_metres(image.depth, camera)
        if frames.segmentation is not None:
            frames.segmentation[row].numpy()[..., 0] = image.segmentation
        if self._markers is not None:
            pose_bodies(self._markers, self._marker_bodies, simulation.target_pose[env])
            marks = self._markers.draw(camera, segmentation=True, shadow=False)
            assert marks.segmentation is not None
            seen = marks.depth < image.depth
            opacity = self._opacity[marks.segmentation[seen]]
            blend(pixels, marks.rgb, seen, opacity)


def pose_solids(
    client: PhysicsClient, scene: Scene, simulation: VectorSimulation, env: int
) -> None:
    """Put the robot and the objects of a client where they are in an environment."""
    joints = simulation.joint_position[env].tolist()
    client.set_joints(scene.robot, scene.joints, joints, (0.0,) * len(joints))
    pose_bodies(client, scene.objects, simulation.object_pose[env])


def pose_bodies(client: PhysicsClient, bodies: tuple[int, ...], poses: Tensor) -> None:
    """Put bodies at poses, (len(bodies), 7: position [m], quaternion xyzw)."""
    for body, pose in zip(bodies, poses.tolist(), strict=True):
        client.set_base(body, pose[:3], pose[3:])


def blend(
    pixels: npt.NDArray[np.uint8],
    marks: npt.NDArray[np.uint8],
    where: npt.NDArray[np.bool_],
    opacity: npt.NDArray[np.float32],
) -> None:
    """Lay translucent marks over pixels, in place.

    Args:
        pixels: (height, width, 3), what lies behind.
        marks: (height, width, 3), what lies in front.
        where: (height, width), where something does.
        opacity: of what does, as many values as ``where`` is true.
    """
    opacity = opacity[:, None]
    mixed = (1 - opacity) * pixels[where] + opacity * marks[where]
    pixels[where] = mixed.round().astype(np.uint8)


def segmentation_ids(build_scene: Callable[[PhysicsClient], Scene]) -> dict[str, int]:
    """What the numbers in segmentations stand for."""
    client = VisualClient("markers")
    with client:
        scene = build_scene(client)
    names = {scene.robot: "robot"}
    for k, body in enumerate(scene.objects):
        names[body] = "object" if len(scene.objects) == 1 else f"object{k + 1}"
    for body, look in client.looks.items():
        if look.name is not None:
            names[body] = look.name
    return {"nothing": NOTHING} | {names[body]: body for body in sorted(names)}
