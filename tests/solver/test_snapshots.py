"""Snapshots with both solvers: the packed one leaves out the collision shapes."""

import pybullet

from tests.solver.solvers import assert_same, needs_packed, solver
from tests.solver.test_scenes import World, pile, scene

pytestmark = needs_packed


def return_to_snapshot(world):
    """Take a snapshot before step 20, and load it before steps 40 and 60."""

    def drive(k):
        if k == 20:
            world.snapshot = world.client.saveState()
        if k in (40, 60):
            world.client.restoreState(world.snapshot)

    world.drive = drive


def test_a_snapshot_with_a_rigid_body_is_left_to_bullet():
    def fill(world):
        pile(world)
        shape = world.client.createCollisionShape(pybullet.GEOM_SPHERE, radius=0.05)
        body = world.client.createMultiBody(
            0.3, shape, -1, (1, 0, 0.5), useMaximalCoordinates=True
        )
        world.bodies.append(body)
        return_to_snapshot(world)

    counts = assert_same(scene(fill), 80, leaves_groups=None)
    assert (counts.snapshots, counts.bullet_snapshots) == (0, 1)


def test_a_file_of_the_world_has_its_shapes(tmp_path):
    world = World()
    world.box(1.0, (0, 0, 0))
    file = tmp_path / "world.bullet"
    with solver("packed"):
        world.client.saveState()
        world.client.saveBullet(str(file))
    assert b"SHAP" in file.read_bytes()
