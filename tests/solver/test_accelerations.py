"""Forward dynamics with both solvers: equal bits, and who accelerates which body."""

import math

import pybullet
import pytest

from tests.solver.solvers import assert_same, needs_packed
from tests.solver.test_scenes import scene

pytestmark = needs_packed
STEPS = 120


def stand(world, **dynamics):
    """A box on the ground, and a chain that hangs beside it and reaches it."""
    world.ground()
    world.box(0.5, (0.1, 0.02, 0.05))
    chain = world.chain(5, (0, 0, 0.7))
    world.client.resetJointState(chain, 0, 0.8)
    for joint in range(5):
        world.client.setJointMotorControl2(
            chain, joint, pybullet.VELOCITY_CONTROL, force=0.01
        )
        if dynamics:
            world.client.changeDynamics(chain, joint, **dynamics)
    return chain


@pytest.mark.parametrize(
    "dynamics",
    [
        {"linearDamping": 0.5, "angularDamping": 0.0},
        {"linearDamping": 0.0, "angularDamping": 0.7},
        {"jointDamping": 0.3},
        {"maxJointVelocity": 0.2},
        {"mass": 0.0},
        {"mass": 50.0},
        {"localInertiaDiagonal": (1e-5, 2e-4, 3e-3)},
    ],
)
def test_links_of_any_dynamics_accelerate_alike(dynamics):
    counts = assert_same(scene(lambda world: stand(world, **dynamics)), STEPS)
    assert (counts.bodies, counts.bullet_bodies) == (STEPS, 0)


@pytest.mark.parametrize("gravity", [(0, 0, 0), (1.0, -2.0, 3.0)])
def test_gravity_of_any_direction_acts_alike(gravity):
    def fill(world):
        stand(world)
        world.client.setGravity(*gravity)

    assert assert_same(scene(fill), STEPS).bodies == STEPS


@pytest.mark.parametrize("frame", [pybullet.WORLD_FRAME, pybullet.LINK_FRAME])
def test_forces_on_links_and_torques_of_joints_act_alike(frame):
    def fill(world):
        chain = stand(world)
        client = world.client
        for joint in range(5):
            client.setJointMotorControl2(
                chain, joint, pybullet.VELOCITY_CONTROL, force=0
            )

        def drive(k):
            push, link = (0.3 * math.sin(k), 0.2, 0.1), k % 6 - 1
            client.applyExternalForce(chain, link, push, (0.01, 0, 0), frame)
            client.applyExternalTorque(chain, link, (0, 0.01, 0.02), frame)
            client.setJointMotorControlArray(
                chain,
                range(5),
                pybullet.TORQUE_CONTROL,
                forces=[0.01 * math.cos(k)] * 5,
            )

        world.drive = drive

    assert assert_same(scene(fill), STEPS).bodies == STEPS


def test_sixteen_bodies_of_a_world_are_accelerated_here():
    def fill(world):
        world.ground()
        for k in range(20):
            world.chain(2, (0.3 * k, 0, 0.5))

    assert assert_same(scene(fill), 30).bodies == 16 * 30


def test_a_chain_falls_asleep_and_wakes_alike():
    def fill(world):
        world.client.setPhysicsEngineParameter(deterministicOverlappingPairs=1)
        world.ground()
        chain = world.chain(2, (0, 0, 0.5))
        world.client.changeDynamics(
            chain, -1, activationState=pybullet.ACTIVATION_STATE_ENABLE_SLEEPING
        )

        def drive(k):
            if k == 700:
                world.client.changeDynamics(
                    chain, -1, activationState=pybullet.ACTIVATION_STATE_WAKE_UP
                )

        world.drive = drive

    counts = assert_same(scene(fill), 900)
    assert 100 < counts.bodies < 800


@pytest.mark.parametrize("joint", [0, 4])
def test_a_body_is_accelerated_here_once_joint_feedback_is_off(joint):
    def fill(world):
        chain = stand(world)

        def drive(k):
            if k in (0, 40):
                world.client.enableJointForceTorqueSensor(chain, joint, k == 0)

        world.drive = drive

    assert assert_same(scene(fill), STEPS).bodies == STEPS - 40


def test_a_fixed_base_with_a_velocity_is_left_to_bullet():
    def fill(world):
        chain = stand(world)
        world.client.resetBaseVelocity(chain, (0.1, 0.2, 0.3), (0.4, 0.5, 0.6))

    assert assert_same(scene(fill), STEPS, leaves_groups=None).bodies == 0


def test_accelerations_of_a_floating_base_are_left_to_bullet():
    def fill(world):
        world.ground()
        world.chain(3, (0, 0, 0.6), base_mass=0.2)

    assert assert_same(scene(fill), STEPS).bodies == 0


@pytest.mark.parametrize("force", [1e300, math.inf, math.nan])
def test_bullet_computes_accelerations_that_are_not_finite_again(force):
    def fill(world):
        chain = stand(world)

        def drive(k):
            if k == 20:
                world.client.applyExternalForce(
                    chain, 2, (force, force, force), (0, 0, 0), pybullet.LINK_FRAME
                )

        world.drive = drive

    counts = assert_same(scene(fill), 40, leaves_groups=None)
    # Afterwards the base's velocity is not finite either: Bullet does everything.
    finite = math.isfinite(force)
    assert (counts.bodies, counts.bullet_bodies) == ((40, 0) if finite else (20, 1))
