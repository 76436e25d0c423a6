"""The blueprint of a scene: the commands that built it, as data.

Two clients hold the same scene if their blueprints are equal. Renderers build their own
copy of a scene from its blueprint.
"""

from typing import NamedTuple

from torch_panda.bullet.shapes import Shape, Visual

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class LoadURDF(NamedTuple):
    """Loads a URDF.

    Attributes:
        body: Id of the new body.
        file: Path of the file. If a tool was added, it is the copy with the tool.
        position: Position of the base, world frame [m].
        orientation: Orientation of the base, quaternion xyzw.
        fixed_base: Whether the base cannot move.
    """

    body: int
    file: str
    position: Vector
    orientation: Quaternion
    fixed_base: bool


class CreateBody(NamedTuple):
    """Creates a body of one shape.

    Attributes:
        body: Id of the new body.
        shape: Shape of the body; None for an invisible marker.
        mass: Mass [kg]; 0 for a body that never moves.
        position: Position of its centre, world frame [m].
        visual: How the body is drawn.
        is_marker: Whether the body is a marker, which touches nothing.
    """

    body: int
    shape: Shape | None
    mass: float
    position: Vector
    visual: Visual
    is_marker: bool


class SetBase(NamedTuple):
    """Moves a body: position [m] and quaternion xyzw, world frame."""

    body: int
    position: Vector
    orientation: Quaternion


class SetJoints(NamedTuple):
    """Moves joints of a body to positions [rad] or [m]."""

    body: int
    joints: tuple[int, ...]
    positions: tuple[float, ...]


class SetCollisionFilter(NamedTuple):
    """Sets the collision group and mask of a link (-1 is the base)."""

    body: int
    link: int
    group: int
    mask: int


class SetPhysics(NamedTuple):
    """Changes the physics of a link, a joint or the world. Renderers ignore it.

    Attributes:
        method: Method of `PhysicsClient` that was called.
        arguments: Its arguments.
    """

    method: str
    arguments: tuple[float | None, ...]


Command = LoadURDF | CreateBody | SetBase | SetJoints | SetCollisionFilter | SetPhysics
Blueprint = tuple[Command, ...]
