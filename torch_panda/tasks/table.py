"""Parts that tasks share: ground, table, cubes, and positions on the table."""

import numpy as np

from torch_panda.bullet import Box, PhysicsClient, Visual
from torch_panda.bullet.shapes import DARK_GREY, GREEN, LIGHT_GREY
from torch_panda.checks import check_above_zero, check_finite

# The table of panda-gym. Its top is the plane z = 0.
TABLE_LENGTH = 1.1  # along x [m]
TABLE_X_OFFSET = -0.3  # x coordinate of its centre [m]
TABLE_WIDTH = 0.7  # [m]
TABLE_HEIGHT = 0.4  # [m]
TABLE_FRICTION = 0.1  # lateral friction, as in panda-gym 1.1.0

CUBE_SIZE = 0.04  # [m]
CUBE = Box((CUBE_SIZE / 2,) * 3)


def create_table(
    client: PhysicsClient,
    *,
    length: float = TABLE_LENGTH,
    x_offset: float = TABLE_X_OFFSET,
    friction: float = TABLE_FRICTION,
) -> None:
    """Create the ground, and a table whose top is the plane z = 0.

    Args:
        client: Client in which the bodies are created.
        length: Length of the table along x [m].
        x_offset: x coordinate of the centre of the table [m].
        friction: Lateral friction of the table. The friction of a contact is the
            product of the two bodies' values.

    Raises:
        ValueError: The length is not above 0, the friction is negative, or a number is
            not finite.
    """
    check_above_zero(length=length)
    check_finite(x_offset=x_offset)
    client.create_box(
        (3.0, 3.0, 0.01),
        mass=0.0,
        position=(0.0, 0.0, -TABLE_HEIGHT - 0.01),
        visual=Visual(DARK_GREY, name="ground"),
    )
    table = client.create_box(
        (length / 2, TABLE_WIDTH / 2, TABLE_HEIGHT / 2),
        mass=0.0,
        position=(x_offset, 0.0, -TABLE_HEIGHT / 2),
        visual=Visual(LIGHT_GREY, name="table"),
    )
    client.set_friction(table, lateral=friction)


def create_cube(
    client: PhysicsClient,
    *,
    mass: float,
    friction: float,
    x: float = 0.0,
    visual: Visual = Visual(GREEN),  # noqa: B008 (frozen)
) -> int:
    """Create a cube on the table and return its body id.

    Args:
        client: Client in which the cube is created.
        mass: Mass [kg].
        friction: Lateral friction.
        x: x coordinate of its centre [m].
        visual: Appearance.
    """
    cube = client.create_box(
        CUBE.half_extents, mass=mass, position=(x, 0.0, CUBE_SIZE / 2), visual=visual
    )
    client.set_friction(cube, lateral=friction)
    return cube


def sample_on_table(
    rng: np.random.Generator, xy_range: float, *, height: float, x_offset: float = 0.0
) -> tuple[float, float, float]:
    """Draw a point at a fixed height above a square.

    Args:
        rng: Random generator.
        xy_range: Edge length of the square [m].
        height: z coordinate of the point [m].
        x_offset: x coordinate of the centre of the square [m]; its y coordinate is 0.
    """
    x, y = rng.uniform(-xy_range / 2, xy_range / 2, size=2)
    return float(x) + x_offset, float(y), height
