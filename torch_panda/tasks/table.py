"""What tasks are made of: the ground, the table, cubes on it, and places on it."""

import numpy as np

from torch_panda.bullet import Box, PhysicsClient, Visual
from torch_panda.bullet.shapes import DARK_GREY, GREEN, LIGHT_GREY

# panda-gym's table; its top is the plane z = 0.
TABLE_LENGTH = 1.1  # [m], along x
TABLE_X_OFFSET = -0.3  # [m], of its centre
TABLE_WIDTH = 0.7  # [m]
TABLE_HEIGHT = 0.4  # [m]
TABLE_FRICTION = 0.1  # lateral, panda-gym 1.1.0's

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
        client: where to.
        length: of the table along x [m].
        x_offset: x of its centre [m].
        friction: its lateral friction. Bullet multiplies that of both bodies.
    """
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
        client: where to.
        mass: [kg].
        friction: its lateral friction.
        x: of its centre [m].
        visual: how it is drawn.
    """
    cube = client.create_box(
        CUBE.half_extents, mass=mass, position=(x, 0.0, CUBE_SIZE / 2), visual=visual
    )
    client.set_friction(cube, lateral=friction)
    return cube


def sample_on_table(
    rng: np.random.Generator, xy_range: float, *, height: float, x_offset: float = 0.0
) -> tuple[float, float, float]:
    """Draw a point at a height, in a square centred at (x_offset, 0) [m]."""
    x, y = rng.uniform(-xy_range / 2, xy_range / 2, size=2)
    return float(x) + x_offset, float(y), height
