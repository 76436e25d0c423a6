"""A client that holds the visuals of bodies, and draws them."""

from collections.abc import Sequence
from ctypes import byref, c_float, c_int
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from torch_panda.bullet import PhysicsClient, capi
from torch_panda.bullet.connection import BulletError, doubles
from torch_panda.bullet.library import library_path
from torch_panda.bullet.shapes import WHITE, Box, Cylinder, Shape, Sphere, Visual
from torch_panda.rendering.camera import Camera, HandCamera
from torch_panda.rendering.egl import RendererName
from torch_panda.rendering.mesh_decimation import decimated_urdf

Layer = Literal["solids", "markers", "all"]

_Z_AXIS = 2
_NOT_SHINY = doubles((0.0, 0.0, 0.0))


class Image(NamedTuple):
    """What a camera sees, valid until the client's next command.

    Attributes:
        rgb: (height, width, 3) uint8.
        depth: (height, width) float32, from 0 at ``near`` to 1 at ``far``, not linear;
            see `camera.to_metres`.
        segmentation: (height, width) int32, the body id of what is seen, -1 where
            nothing is; None if it was not asked for.
    """

    rgb: npt.NDArray[np.uint8]
    depth: npt.NDArray[np.float32]
    segmentation: npt.NDArray[np.int32] | None


class VisualClient(PhysicsClient):
    """A client that draws; it is built as a `PhysicsClient` and not stepped.

    Bullet's software renderer knows no translucency. So what is opaque and what is
    translucent are two layers, in a client each, for the caller to blend.

    Args:
        layer: what is seen: "solids", the "markers" only, or "all", for a renderer
            that draws markers translucent itself.
        renderer: "tiny": Bullet's software renderer; "egl": its OpenGL renderer, whose
            client must be made, used and closed by one thread.
        mesh_cell: merge the vertices of robots' meshes in cubes of this edge length
            [m]; see `decimated_urdf`. 0 leaves them as they are.

    Attributes:
        visuals: how bodies are drawn, by body id.
    """

    def __init__(
        self,
        layer: Layer = "solids",
        *,
        renderer: RendererName = "tiny",
        mesh_cell: float = 0.0,
    ) -> None:
        super().__init__()
        # The shadows of the first two pictures of Bullet's OpenGL renderer are wrong.
        self._warm_up = 2 if renderer == "egl" else 0
        if renderer == "egl":
            self._load_egl()
        self._layer = layer
        self._mesh_cell = mesh_cell
        if layer != "markers":
            self._urdf_flags = 0
        self.visuals: dict[int, Visual] = {}

    def draw(
        self,
        camera: Camera,
        hand: Sequence[float] = (),
        *,
        segmentation: bool = False,
        shadow: bool = True,
    ) -> Image:
        """Draw what a camera sees.

        Args:
            camera: the camera.
            hand: (7,), where a `HandCamera` is mounted; see `HandCamera.placed`.
            segmentation: whether to tell the bodies apart.
            shadow: whether bodies cast shadows.
        """
        view, projection = (c_float * 16)(), (c_float * 16)()
        if isinstance(camera, HandCamera):
            capi.view_matrix_from_positions(
                *((c_float * 3)(*point) for point in camera.placed(hand)), view
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
        while self._warm_up:
            self._warm_up -= 1
            self.draw(camera, hand, shadow=shadow)
        command = capi.camera_init(self._open())
        capi.camera_set_matrices(command, view, projection)
        capi.camera_set_size(command, camera.width, camera.height)
        capi.camera_set_shadow(command, int(shadow))
        flags = 0 if segmentation else capi.ER_NO_SEGMENTATION_MASK
        capi.camera_set_flags(command, flags)
        self._submit(command, capi.CMD_CAMERA_IMAGE_COMPLETED, "draw")
        data = capi.CameraImage()
        capi.camera_result(self._handle, byref(data))
        size = (camera.height, camera.width)
        return Image(
            np.ctypeslib.as_array(data.rgba, shape=(*size, 4))[..., :3],
            np.ctypeslib.as_array(data.depth, shape=size),
            np.ctypeslib.as_array(data.segmentation, shape=size)
            if segmentation
            else None,
        )

    def _load_egl(self) -> None:
        command = capi.plugin_init(self._open())
        capi.plugin_set_path(command, library_path("eglRenderer").encode())
        capi.plugin_set_suffix(command, b"_eglRendererPlugin")
        status = self._submit(
            command, capi.CMD_CUSTOM_COMMAND_COMPLETED, "load its EGL renderer"
        )
        if capi.status_plugin(status) < 0:
            raise BulletError("Bullet could not load its EGL renderer")

    # ---- visuals -----------------------------------------------------------------

    def _drawn_urdf(self, file: str) -> str:
        if self._mesh_cell > 0 and self._layer == "solids":
            return str(decimated_urdf(file, self._mesh_cell))
        return file

    def _create_body(
        self,
        shape: Shape | None,
        mass: float,
        position: Sequence[float],
        visual: Visual,
        *,
        is_marker: bool = False,
    ) -> int:
        body = super()._create_body(shape, mass, position, visual, is_marker=is_marker)
        self.visuals[body] = visual
        if visual.texture is not None and self._draws(is_marker):
            path = str(visual.texture).encode()
            command = capi.texture_init(self._open(), path)
            status = self._submit(
                command, capi.CMD_LOAD_TEXTURE_COMPLETED, f"load {visual.texture}"
            )
            texture = capi.status_texture(status)
            command = capi.visual_update_init(self._open(), body, -1, -1)
            capi.visual_update_texture(command, texture)
            self._submit(
                command, capi.CMD_VISUAL_SHAPE_UPDATE_COMPLETED, "set a texture"
            )
        return body

    def _create_collision_shape(self, shape: Shape) -> int:
        # Bullet draws the collision shape of a body that has no visual shape.
        return -1

    def _create_visual_shape(
        self, shape: Shape, visual: Visual, *, is_marker: bool
    ) -> int:
        if not self._draws(is_marker):
            return -1
        handle = self._open()
        command = capi.visual_init(handle)
        match shape:
            case Box(half_extents) if visual.texture is not None:
                add_textured_box(handle, command, half_extents)
            case Box(half_extents):
                capi.visual_add_box(command, doubles(half_extents))
            case Cylinder(radius, height):
                capi.visual_add_cylinder(command, radius, height)
            case Sphere(radius):
                capi.visual_add_sphere(command, radius)
        color = visual.color if visual.texture is None else WHITE
        opacity = visual.opacity if is_marker and self._layer == "all" else 1.0
        capi.visual_set_color(command, 0, doubles((*color, opacity)))
        capi.visual_set_specular(command, 0, _NOT_SHINY)
        status = self._submit(
            command, capi.CMD_CREATE_VISUAL_SHAPE_COMPLETED, "create a visual shape"
        )
        return capi.status_visual(status)

    def _draws(self, is_marker: bool) -> bool:
        return self._layer == "all" or is_marker == (self._layer == "markers")


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
            # Right and up on the face, so that right x up points outwards.
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
