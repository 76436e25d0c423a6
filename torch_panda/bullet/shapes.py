"""The shapes of bodies, and their visuals."""

from dataclasses import dataclass
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


@dataclass(frozen=True)
class Visual:
    """How a body is drawn.

    Attributes:
        color: red, green and blue, from 0 to 1.
        texture: of a box, instead of the colour: an image of three by two squares,
            the faces +x, +y, +z above and -x, -y, -z below.
        opacity: of a marker, which is seen through; other bodies are opaque.
        name: what segmented images call the body; None: what the task uses it for.
    """

    color: Color = GREEN
    texture: Path | None = None
    opacity: float = 0.3
    name: str | None = None
