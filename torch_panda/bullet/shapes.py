"""Shapes of bodies, and how renderers draw them."""

from pathlib import Path
from typing import NamedTuple

# Red, green and blue, from 0 to 1.
Color = tuple[float, float, float]

# panda-gym's colours.
RED: Color = (0.9, 0.1, 0.1)
GREEN: Color = (0.1, 0.9, 0.1)
BLUE: Color = (0.1, 0.1, 0.9)
WHITE: Color = (1.0, 1.0, 1.0)
LIGHT_GREY: Color = (0.95, 0.95, 0.95)
DARK_GREY: Color = (0.15, 0.15, 0.15)


class Box(NamedTuple):
    """A box, by half its edge lengths along x, y and z [m]."""

    half_extents: tuple[float, float, float]


class Cylinder(NamedTuple):
    """An upright cylinder [m]."""

    radius: float
    height: float


class Sphere(NamedTuple):
    """A sphere [m]."""

    radius: float


Shape = Box | Cylinder | Sphere


class Visual(NamedTuple):
    """How renderers draw a body.

    Attributes:
        color: Red, green and blue, from 0 to 1.
        texture: Image file that replaces the colour of a box; None keeps the colour.
            The image shows the faces of the box in two rows of three squares: +x, +y
            and +z in the upper row, -x, -y and -z in the lower row.
        opacity: Opacity of a marker, from 0 to 1. Other bodies are opaque.
        name: Name of the body in `RobotTaskEnv.segmentation_ids`; None means its role
            in the task, for example "object1".
    """

    color: Color = GREEN
    texture: Path | None = None
    opacity: float = 0.3
    name: str | None = None
