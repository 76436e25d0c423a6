"""A copy of the scene that is drawn instead of the physics."""

from typing import Protocol

import numpy as np
from torch import Tensor

from torch_panda.bullet import BulletError, PhysicsClient, Scene, VectorSimulation
from torch_panda.rendering.camera import Camera, to_metres
from torch_panda.rendering.egl import RendererName
from torch_panda.rendering.frames import Frames, blend
from torch_panda.rendering.visual_client import VisualClient

NOTHING = -1  # in a segmentation
_OUT_OF_SIGHT = (0.0, 0.0, -500.0)  # where URDFs are put among markers [m]
# What changes nothing that is seen: robots do so, too.
_NOT_SEEN = {"set_dynamics", "set_joint_friction"}


class SceneBuilder(Protocol):
    """Builds a scene in any client."""

    def __call__(self, client: PhysicsClient) -> Scene:
        """Build robot and task."""

    def build_markers(self, client: PhysicsClient) -> tuple[int, ...]:
        """Build the task alone, and return the body ids of its markers."""


class SceneRenderer:
    """Draws one environment at a time, in a copy of the scene with visual shapes.

    So that physics clients carry no visual shapes, and one renderer draws for many.

    Args:
        simulation: whose scene and state are drawn.
        build_scene: builds the scene of the simulation.
        renderer: "tiny" or "egl", what draws the scene.
        mesh_cell: how coarse the robot's meshes are [m]; see `VisualClient`.
    """

    def __init__(
        self,
        simulation: VectorSimulation,
        build_scene: SceneBuilder,
        *,
        renderer: RendererName = "tiny",
        mesh_cell: float = 0.0,
    ) -> None:
        self._simulation = simulation
        self._solids = VisualClient("solids", renderer=renderer, mesh_cell=mesh_cell)
        self._markers: VisualClient | None = None
        try:
            simulation.check_same(self._solids, build_scene(self._solids))
            if simulation.scene.markers:
                self._markers = VisualClient("markers")
                self._marker_bodies = build_scene.build_markers(self._markers)
                _check_same_task(self._markers, self._solids)
                bodies, visuals = self._markers.bodies, self._markers.visuals
                self._opacity = np.zeros(max(bodies) + 1, dtype=np.float32)
                for body, visual in visuals.items():
                    self._opacity[body] = visual.opacity
                # Bullet draws their collision shapes, which would hide markers.
                for body in set(bodies) - visuals.keys() - set(self._marker_bodies):
                    self._markers.set_base(body, _OUT_OF_SIGHT)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Free the clients. Closing again does nothing."""
        self._solids.close()
        if self._markers is not None:
            self._markers.close()

    def draw(self, env: int, camera: Camera, frames: Frames, row: int) -> None:
        """Draw an environment as the state tensors have it.

        Depth and segmentation are of the robot and the things in the scene. Markers
        are seen in the pixels only: they show what should be, not what is.

        Args:
            env: which environment.
            camera: the camera.
            frames: of the camera's size; receives the picture.
            row: where in ``frames``.
        """
        simulation, solids = self._simulation, self._solids
        scene = simulation.scene
        pose_solids(solids, scene, simulation, env)
        hand = [
            *simulation.ee_position[env].tolist(),
            *simulation.ee_orientation[env].tolist(),
        ]
        image = solids.draw(
            camera,
            hand,
            segmentation=frames.segmentation is not None,
            shadow=camera.shadows,
        )
        pixels = frames.pixels[row].numpy()
        pixels[:] = image.rgb
        if frames.depth is not None:
            frames.depth[row].numpy()[..., 0] = to_metres(image.depth, camera)
        if frames.segmentation is not None:
            frames.segmentation[row].numpy()[..., 0] = image.segmentation
        if self._markers is not None:
            pose_bodies(self._markers, self._marker_bodies, simulation.marker_pose[env])
            overlay = self._markers.draw(camera, hand, segmentation=True, shadow=False)
            assert overlay.segmentation is not None
            seen = overlay.depth < image.depth
            opacity = self._opacity[overlay.segmentation[seen]]
            blend(pixels, overlay.rgb, seen, opacity)


def _check_same_task(markers: VisualClient, solids: VisualClient) -> None:
    """Make sure that the task has built the same bodies, among those of others."""
    ours, theirs = (
        [command for command in client.blueprint if command[0] not in _NOT_SEEN]
        for client in (markers, solids)
    )
    starts = range(len(theirs) - len(ours) + 1)
    if not any(theirs[k : k + len(ours)] == ours for k in starts):
        raise BulletError(
            f"the scene must be the same in every client, got {ours} after {theirs}"
        )


def pose_solids(
    client: PhysicsClient, scene: Scene, simulation: VectorSimulation, env: int
) -> None:
    """Put the robot and the objects of a client where they are in an environment."""
    joints = simulation.joint_position[env].tolist()
    client.set_joints(scene.robot, scene.joints, joints, (0.0,) * len(joints))
    pose_bodies(client, scene.objects, simulation.object_pose[env])
    positions = simulation.object_joint_position[env].tolist()
    for body, joints in zip(scene.objects, scene.object_joints, strict=True):
        own, positions = positions[: len(joints)], positions[len(joints) :]
        if joints:
            client.set_joints(body, joints, own, (0.0,) * len(joints))


def pose_bodies(client: PhysicsClient, bodies: tuple[int, ...], poses: Tensor) -> None:
    """Put bodies at poses, (len(bodies), 7: position [m], quaternion xyzw)."""
    for body, pose in zip(bodies, poses.tolist(), strict=True):
        client.set_base(body, pose[:3], pose[3:])


def segmentation_ids(build_scene: SceneBuilder) -> dict[str, int]:
    """What the numbers in segmentations stand for."""
    client = VisualClient("markers")
    with client:
        scene = build_scene(client)
    names = {scene.robot: "robot"}
    for k, body in enumerate(scene.objects):
        names[body] = "object" if len(scene.objects) == 1 else f"object{k + 1}"
    for body, visual in client.visuals.items():
        if visual.name is not None:
            names[body] = visual.name
    return {"nothing": NOTHING} | {names[body]: body for body in sorted(names)}
