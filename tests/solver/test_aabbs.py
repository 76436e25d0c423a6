"""The broad phase with both solvers: equal trees, and who moves which AABB."""

import math

import pybullet

from tests.solver.solvers import assert_same, needs_packed
from tests.solver.test_scenes import pile, scene
from tests.solver.test_tasks import environment

pytestmark = needs_packed


def observe_tree(world):
    """Add the order of the tree's leaves to the state."""
    state = world.state

    def tree_state():
        everything = ((-9, -9, -9), (9, 9, 9))
        return state() + repr(world.client.getOverlappingObjects(*everything)).encode()

    world.state = tree_state


def crowd(world, num_boxes):
    """Boxes in the air that fall onto the ground and onto each other."""
    world.ground()
    for k in range(num_boxes):
        position = (0.3 * math.sin(2.4 * k), 0.3 * math.cos(2.4 * k), 0.1 + 0.07 * k)
        world.box(0.2, position)
    observe_tree(world)


def test_a_task_leaves_few_aabbs_to_bullet():
    counts = assert_same(environment("PandaPush-v3"), 10)
    assert counts.aabbs > 100 * counts.bullet_aabbs


def test_a_crowd_has_the_same_tree():
    counts = assert_same(scene(lambda world: crowd(world, 30)), 200)
    assert counts.aabbs > counts.bullet_aabbs > 0


def test_aabbs_of_a_world_of_more_than_64_bodies_are_left_to_bullet():
    assert assert_same(scene(lambda world: crowd(world, 63)), 60).aabbs > 0
    counts = assert_same(scene(lambda world: crowd(world, 64)), 60)
    assert counts.aabbs == counts.bullet_aabbs == 0


def test_a_single_body_is_left_to_bullet():
    def fill(world):
        world.box(1.0, (0, 0, 0))

    counts = assert_same(scene(fill), 20, leaves_groups=None)
    assert (counts.aabbs, counts.bullet_aabbs) == (0, 20)


def test_pairs_that_are_filtered_out_are_left_to_bullet():
    def fill(world):
        pile(world)
        observe_tree(world)
        for body in world.bodies[1:4]:
            world.client.setCollisionFilterGroupMask(body, -1, 0, 0)

    counts = assert_same(scene(fill), 120)
    assert counts.aabbs > 0
    assert counts.bullet_aabbs > 120


def test_bodies_that_jump_come_and_go_have_the_same_tree():
    def fill(world):
        crowd(world, 12)
        client = world.client

        def drive(k):
            if k % 7 == 3:
                body = world.bodies[1 + k % 5]
                client.resetBasePositionAndOrientation(
                    body, (0.1 * math.sin(k), 0.2, 0.5), (0, 0, 0, 1)
                )
            if k % 10 == 5:
                client.removeBody(world.bodies.pop(2))
                world.box(0.3, (0, 0, 0.6))

        world.drive = drive

    counts = assert_same(scene(fill), 100)
    assert counts.aabbs > counts.bullet_aabbs > 0


def test_bodies_that_fall_asleep_move_no_aabbs():
    def fill(world):
        world.client.setPhysicsEngineParameter(deterministicOverlappingPairs=1)
        crowd(world, 4)
        for body in world.bodies:
            world.client.changeDynamics(
                body, -1, activationState=pybullet.ACTIVATION_STATE_ENABLE_SLEEPING
            )

    counts = assert_same(scene(fill), 700, leaves_groups=None)
    assert 0 < counts.aabbs < 4 * 690


def test_another_broad_phase_is_left_to_bullet():
    def fill(world):
        world.client.resetSimulation(pybullet.RESET_USE_SIMPLE_BROADPHASE)
        world.client.setGravity(0, 0, -9.81)
        pile(world)

    counts = assert_same(scene(fill), 60)
    assert counts.aabbs == counts.bullet_aabbs == 0
