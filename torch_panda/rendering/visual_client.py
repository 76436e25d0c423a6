"""A client of Bullet that holds the visual shapes of a scene and renders them."""

from collections.abc import Sequence
from ctypes import byref, c_float, c_int
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from torch import Tensor
from typing_extensions import Self

from torch_panda.bullet import Blueprint, Scene, SimulationState, building, capi
from torch_panda.bullet.blueprint import CreateBody, LoadURDF, SetBase, SetJoints
from torch_panda.bullet.connection import BulletError, Connection, connect, doubles
from torch_panda.bullet.library import library_path
from torch_panda.bullet.shapes import WHITE, Box, Cylinder, Sphere
from torch_panda.rendering.camera import Camera, HandCamera
from torch_panda.rendering.egl import RendererName
from torch_panda.rendering.mesh_decimation import decimated_urdf

Layer = Literal["solids", "markers", "all"]

_Z_AXIS = 2
_NOT_SHINY = doubles((0.0, 0.0, 0.0))


class Image(NamedTuple):
    """A camera's image. The arrays share Bullet's memory.

    They are valid until the client's next command.

    Attributes:
        rgb: (height, width, 3) uint8.
        depth: (height, width) float32, from 0 at ``near`` to 1 at ``far``, but not
            linear in between; `camera.to_metres` converts it.
        segmentation: (height, width) int32, body id of every pixel, -1 for the
            background; None if it was not requested.
    """

    rgb: npt.NDArray[np.uint8]
    depth: npt.NDArray[np.float32]
    segmentation: npt.NDArray[np.int32] | None


class VisualClient:
    """A client that holds the visual shapes of a scene and renders them.

    It has no physics and takes no steps: `pose` moves the bodies.

    Bullet's software renderer has no translucency. Two clients therefore render the
    scene in two layers, one with the opaque bodies and one with the translucent
    markers, and the caller blends the two pictures. In every layer, bodies have the
    same ids as in the physics clients.

    Args:
        blueprint: Commands that built the scene in a physics client.
        layer: Bodies to render: "solids", "markers", or "all". "all" needs "egl" or a
            window, because markers are translucent.
        renderer: "tiny", Bullet's software renderer, or "egl", its OpenGL renderer. One
            thread must make, use and close a client of "egl".
        mesh_cell: Edge length of the cubes in which the vertices of a mesh are merged
            [m]; see `decimated_urdf`. 0 renders all details.
        connection: Connection to a client with a window; None makes one without.
    """

    def __init__(
        self,
        blueprint: Blueprint,
        layer: Layer = "solids",
        *,
        renderer: RendererName = "tiny",
        mesh_cell: float = 0.0,
        connection: Connection | None = None,
    ) -> None:
        self._connection = connect() if connection is None else connection
        self._layer = layer
        self._mesh_cell = mesh_cell
        # The shadows in the first two pictures of Bullet's OpenGL renderer are wrong.
        self._num_to_discard = 2 if renderer == "egl" else 0
        try:
            if renderer == "egl":
                self._load_egl()
            self._build(blueprint)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Free the client. Closing again does nothing."""
        self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def pose(self, scene: Scene, state: SimulationState, env: int) -> None:
        """Move the bodies of the layer to their poses in an environment."""
        if self._layer != "markers":
            positions = state.joint_position[env].tolist()
            self._set_joints(scene.robot, scene.joints, positions)
            self._pose_bodies(scene.objects, state.object_pose[env])
            sizes = [len(joints) for joints in scene.object_joints]
            parts = state.object_joint_position[env].split(sizes)
            for body, joints, part in zip(
                scene.objects, scene.object_joints, parts, strict=True
            ):
                if joints:
                    self._set_joints(body, joints, part.tolist())
        if self._layer != "solids":
            self._pose_bodies(scene.markers, state.marker_pose[env])

    def _pose_bodies(self, bodies: Sequence[int], poses: Tensor) -> None:
        for body, pose in zip(bodies, poses.tolist(), strict=True):
            building.set_base(self._connection, body, pose[:3], pose[3:])

    def _set_joints(
        self, body: int, joints: Sequence[int], positions: Sequence[float]
    ) -> None:
        at_rest = (0.0,) * len(joints)
        building.set_joints(self._connection, body, joints, positions, at_rest)

    def render(
        self,
        camera: Camera,
        ee_pose: Sequence[float] = (),
        *,
        segmentation: bool = False,
        shadow: bool = True,
    ) -> Image:
        """Render what a camera sees.

        Args:
            camera: The camera.
            ee_pose: Pose of the end-effector (7,), which only a `HandCamera` needs; see
                `HandCamera.in_world`.
            segmentation: Whether the image has a segmentation.
            shadow: Whether bodies cast shadows.
        """
        view, projection = (c_float * 16)(), (c_float * 16)()
        if isinstance(camera, HandCamera):
            capi.view_matrix_from_positions(
                *((c_float * 3)(*point) for point in camera.in_world(ee_pose)), view
            )
        else:
            capi.view_matrix(
                (c_float * 3)(*camera.target),
                camera.distance,
                camera.yaw,
                camera.pitch,
                camera.roll,
                _Z_AXIS,
                view,
            )
        aspect = camera.width / camera.height
        capi.projection_matrix(camera.fov, aspect, camera.near, camera.far, projection)
        for _ in range(self._num_to_discard + 1):
            command = capi.camera_init(self._connection.handle)
            capi.camera_set_matrices(command, view, projection)
            capi.camera_set_size(command, camera.width, camera.height)
            capi.camera_set_shadow(command, int(shadow))
            flags = 0 if segmentation else capi.ER_NO_SEGMENTATION_MASK
            capi.camera_set_flags(command, flags)
            self._connection.submit(command, capi.CMD_CAMERA_IMAGE_COMPLETED, "render")
        self._num_to_discard = 0
        data = capi.CameraImage()
        capi.camera_result(self._connection.handle, byref(data))
        size = (camera.height, camera.width)
        return Image(
            np.ctypeslib.as_array(data.rgba, shape=(*size, 4))[..., :3],
            np.ctypeslib.as_array(data.depth, shape=size),
            np.ctypeslib.as_array(data.segmentation, shape=size)
            if segmentation
            else None,
        )

    def _load_egl(self) -> None:
        command = capi.plugin_init(self._connection.handle)
        capi.plugin_set_path(command, library_path("eglRenderer").encode())
        capi.plugin_set_suffix(command, b"_eglRendererPlugin")
        status = self._connection.submit(
            command, capi.CMD_CUSTOM_COMMAND_COMPLETED, "load its EGL renderer"
        )
        if capi.status_plugin(status) < 0:
            raise BulletError("Bullet could not load its EGL renderer")

    # ---- building ----------------------------------------------------------------

    def _build(self, blueprint: Blueprint) -> None:
        connection, num_bodies = self._connection, 0
        for command in blueprint:
            match command:
                case LoadURDF(body) | CreateBody(body):
                    # If a physics client failed to build a body, the body's id stays
                    # unused there. Use it up here too, with an empty body.
                    for _ in range(num_bodies, body):
                        building.create_body(connection, building.ORIGIN)
                    self._build_body(command)
                    num_bodies = body + 1
                case SetBase(body, position, orientation):
                    building.set_base(connection, body, position, orientation)
                case SetJoints(body, joints, positions) if self._layer != "markers":
                    self._set_joints(body, joints, positions)

    def _build_body(self, command: LoadURDF | CreateBody) -> None:
        """Build a body: with visual shapes if this layer shows it, else without."""
        is_marker = isinstance(command, CreateBody) and command.is_marker
        if self._layer != "all" and is_marker != (self._layer == "markers"):
            building.create_body(self._connection, command.position)
        elif isinstance(command, LoadURDF):
            self._load_urdf(command)
        else:
            self._create_body(command)

    def _load_urdf(self, urdf: LoadURDF) -> None:
        file = urdf.file
        if self._mesh_cell > 0:
            file = str(decimated_urdf(file, self._mesh_cell))
        building.load_urdf(
            self._connection,
            file,
            urdf.position,
            urdf.orientation,
            fixed_base=urdf.fixed_base,
            flags=0,
        )

    def _create_body(self, command: CreateBody) -> None:
        # Give the body no collision shape, because Bullet draws the collision shape of
        # a body that has no visual shape.
        shape = building.NO_SHAPE
        if command.shape is not None:
            shape = self._create_shape(command)
        body = building.create_body(
            self._connection, command.position, visual_shape=shape
        )
        if command.visual.texture is not None and command.shape is not None:
            self._set_texture(body, command.visual.texture)

    def _create_shape(self, body: CreateBody) -> int:
        handle, visual = self._connection.handle, body.visual
        command = capi.visual_init(handle)
        match body.shape:
            case Box(half_extents) if visual.texture is not None:
                add_textured_box(handle, command, half_extents)
            case Box(half_extents):
                capi.visual_add_box(command, doubles(half_extents))
            case Cylinder(radius, height):
                capi.visual_add_cylinder(command, radius, height)
            case Sphere(radius):
                capi.visual_add_sphere(command, radius)
        color = visual.color if visual.texture is None else WHITE
        is_translucent = body.is_marker and self._layer == "all"
        opacity = visual.opacity if is_translucent else 1.0
        capi.visual_set_color(command, 0, doubles((*color, opacity)))
        capi.visual_set_specular(command, 0, _NOT_SHINY)
        status = self._connection.submit(
            command, capi.CMD_CREATE_VISUAL_SHAPE_COMPLETED, "create a visual shape"
        )
        return int(capi.status_visual(status))

    def _set_texture(self, body: int, path: Path) -> None:
        handle = self._connection.handle
        status = self._connection.submit(
            capi.texture_init(handle, str(path).encode()),
            capi.CMD_LOAD_TEXTURE_COMPLETED,
            f"load {path}",
        )
        texture = capi.status_texture(status)
        command = capi.visual_update_init(handle, body, -1, -1)
        capi.visual_update_texture(command, texture)
        self._connection.submit(
            command, capi.CMD_VISUAL_SHAPE_UPDATE_COMPLETED, "set a texture"
        )


def add_textured_box(
    handle: int, command: int, half_extents: tuple[float, float, float]
) -> None:
    """Add a box whose faces show the six squares of a texture; see `Visual`.

    Bullet's own boxes show the whole texture on each face.
    """
    vertices: list[float] = []
    normals: list[float] = []
    coordinates: list[float] = []
    indices: list[int] = []
    for row, sign in enumerate((1.0, -1.0)):
        for axis in range(3):
            # Axes along the face, which point right and up as seen from outside.
            right, up = (axis + 1) % 3, (axis + 2) % 3
            first = len(vertices) // 3
            for u, v in ((0, 0), (1, 0), (1, 1), (0, 1)):
                vertex, normal = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
                vertex[axis] = sign * half_extents[axis]
                vertex[right] = sign * (2 * u - 1) * half_extents[right]
                vertex[up] = (2 * v - 1) * half_extents[up]
                normal[axis] = sign
                vertices += vertex
                normals += normal
                coordinates += [(axis + u) / 3, 1 - (row + 1 - v) / 2]
            indices += [first + k for k in (0, 1, 2, 0, 2, 3)]
    capi.visual_add_mesh(
        handle,
        command,
        doubles((1.0, 1.0, 1.0)),
        doubles(vertices),
        len(vertices) // 3,
        (c_int * len(indices))(*indices),
        len(indices),
        doubles(normals),
        len(normals) // 3,
        doubles(coordinates),
        len(coordinates) // 2,
    )
