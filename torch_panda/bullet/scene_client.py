"""Building a world of bodies in a client."""

import threading
from collections.abc import Sequence
from pathlib import Path

from torch_panda.bullet import capi
from torch_panda.bullet.connection import doubles
from torch_panda.bullet.link_client import LinkClient
from torch_panda.bullet.shapes import Box, Cylinder, Shape, Sphere, Visual
from torch_panda.bullet.urdf import (
    Tool,
    check_collision_filters,
    find_urdf,
    urdf_with_tool,
)
from torch_panda.checks import check_not_negative, check_quaternion

ORIGIN = (0.0, 0.0, 0.0)
NO_ROTATION = (0.0, 0.0, 0.0, 1.0)

# Bullet's importer shares its caches between clients: two threads in it crash.
_IMPORTER = threading.Lock()


class SceneClient(LinkClient):
    """A client in which a scene is built.

    Nothing is drawn here: visuals are for a `VisualClient`, in which the same calls
    build the same bodies to be seen.
    """

    _urdf_flags = capi.URDF_IGNORE_VISUAL_SHAPES

    def __init__(self) -> None:
        self._bodies: list[int] = []
        super().__init__()

    @property
    def bodies(self) -> tuple[int, ...]:
        """Ids of the bodies, in the order in which they were built."""
        return tuple(self._bodies)

    def load_urdf(
        self,
        path: str | Path,
        *,
        position: Sequence[float] = ORIGIN,
        orientation: Sequence[float] = NO_ROTATION,
        fixed_base: bool = False,
        tool: Tool | None = None,
    ) -> int:
        """Load a URDF, here without its visual shapes, and return its body id.

        Args:
            path: a file, or a name among those that pybullet ships.
            position: of the base, world frame [m].
            orientation: of the base, quaternion xyzw.
            fixed_base: whether the base cannot move.
            tool: a link to be added.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it chooses its own collision groups or masks, which Bullet does
                not report and `set_collision_filter` could therefore not restore.
            BulletError: Bullet cannot read it.
        """
        file = find_urdf(path)
        if tool is not None:
            file = urdf_with_tool(file, tool)
        check_collision_filters(file)
        check_quaternion("orientation", orientation)
        pose = tuple(map(float, (*position, *orientation)))
        self._note("load_urdf", file, pose, fixed_base)
        file = self._drawn_urdf(file)
        command = capi.urdf_init(self._open(), file.encode())
        capi.urdf_set_position(command, *position)
        capi.urdf_set_orientation(command, *orientation)
        capi.urdf_set_fixed_base(command, int(fixed_base))
        capi.urdf_set_flags(command, self._urdf_flags)
        with _IMPORTER:
            status = self._submit(
                command, capi.CMD_URDF_LOADING_COMPLETED, f"load {path}"
            )
        return self._add_body(status)

    def create_box(
        self,
        half_extents: Sequence[float],
        *,
        mass: float,
        position: Sequence[float],
        visual: Visual = Visual(),  # noqa: B008 (frozen)
    ) -> int:
        """Create a box and return its body id.

        Args:
            half_extents: along x, y and z [m].
            mass: [kg]; 0 makes a body that never moves.
            position: of its centre, world frame [m].
            visual: how a `VisualClient` draws it.
        """
        x, y, z = half_extents
        return self._create_body(Box((x, y, z)), mass, position, visual)

    def create_cylinder(
        self,
        radius: float,
        height: float,
        *,
        mass: float,
        position: Sequence[float],
        visual: Visual = Visual(),  # noqa: B008 (frozen)
    ) -> int:
        """Create an upright cylinder and return its body id; see `create_box`."""
        return self._create_body(Cylinder(radius, height), mass, position, visual)

    def create_sphere(
        self,
        radius: float,
        *,
        mass: float,
        position: Sequence[float],
        visual: Visual = Visual(),  # noqa: B008 (frozen)
    ) -> int:
        """Create a sphere and return its body id; see `create_box`."""
        return self._create_body(Sphere(radius), mass, position, visual)

    def create_marker(
        self,
        position: Sequence[float],
        shape: Shape | None = None,
        *,
        visual: Visual = Visual(),  # noqa: B008 (frozen)
    ) -> int:
        """Create a body that nothing touches, and return its id.

        Args:
            position: world frame [m].
            shape: what a `VisualClient` draws, translucent; None: nothing.
            visual: how it draws it.
        """
        return self._create_body(shape, 0.0, position, visual, is_marker=True)

    def _create_body(
        self,
        shape: Shape | None,
        mass: float,
        position: Sequence[float],
        visual: Visual,
        *,
        is_marker: bool = False,
    ) -> int:
        check_not_negative(mass=mass)
        kind = "create_marker" if is_marker else "create_body"
        place = tuple(map(float, position))
        self._note(kind, shape, mass, place, visual)
        collision = visual_shape = -1
        if shape is not None:
            visual_shape = self._create_visual_shape(shape, visual, is_marker=is_marker)
            if not is_marker:
                collision = self._create_collision_shape(shape)
        rotation, origin = doubles(NO_ROTATION), doubles(ORIGIN)
        command = capi.body_init(self._open())
        capi.body_set_base(
            command,
            mass,
            collision,
            visual_shape,
            doubles(position),
            rotation,
            origin,
            rotation,
        )
        status = self._submit(
            command, capi.CMD_CREATE_MULTI_BODY_COMPLETED, "create a body"
        )
        return self._add_body(status)

    def _drawn_urdf(self, file: str) -> str:
        """A URDF that stands for another one; here, where none is drawn, itself."""
        return file

    def _add_body(self, status: int) -> int:
        body: int = capi.status_body(status)
        self._bodies.append(body)
        return body

    def _create_collision_shape(self, shape: Shape) -> int:
        command = capi.shape_init(self._open())
        match shape:
            case Box(half_extents):
                capi.shape_add_box(command, doubles(half_extents))
            case Cylinder(radius, height):
                capi.shape_add_cylinder(command, radius, height)
            case Sphere(radius):
                capi.shape_add_sphere(command, radius)
        status = self._submit(
            command, capi.CMD_CREATE_COLLISION_SHAPE_COMPLETED, "create a shape"
        )
        return capi.status_shape(status)

    def _create_visual_shape(
        self, shape: Shape, visual: Visual, *, is_marker: bool
    ) -> int:
        """A shape to be seen; -1, as here, is none."""
        return -1
