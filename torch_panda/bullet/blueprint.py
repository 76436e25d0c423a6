"""The blueprint of a scene: the commands that built it, as data.

Two clients hold the same scene if their blueprints are equal. Renderers build their own
copy of a scene from its blueprint.
"""

from dataclasses import dataclass

from torch_panda.bullet.shapes import Shape, Visual

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


@dataclass(frozen=True)
class LoadURDF:
    """Loads a URDF.

    Attributes:
        body: Id that the new body got.
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


@dataclass(frozen=True)
class CreateBody:
    """Creates a body of one shape.

    Attributes:
        body: Id that the new body got.
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


@dataclass(frozen=True)
class SetBase:
    """Moves a body: position [m] and quaternion xyzw, world frame."""

    body: int
    position: Vector
    orientation: Quaternion


@dataclass(frozen=True)
class SetJoints:
    """Moves joints of a body to positions [rad] or [m]."""

    body: int
    joints: tuple[int, ...]
    positions: tuple[float, ...]


@dataclass(frozen=True)
class SetCollisionFilter:
    """Sets the collision group and mask of a link (-1 is the base)."""

    body: int
    link: int
    group: int
    mask: int


@dataclass(frozen=True)
class SetPhysics:
    """Changes physical properties of a link or joint, which renderers ignore.

    Attributes:
        method: Method of `PhysicsClient` that was called.
        arguments: Its arguments.
    """

    method: str
    arguments: tuple[float | None, ...]


Command = LoadURDF | CreateBody | SetBase | SetJoints | SetCollisionFilter | SetPhysics
Blueprint = tuple[Command, ...]
