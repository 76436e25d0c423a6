"""Scenes that the tasks don't have, with both solvers: equal bits after every step."""

import math

import numpy as np
import pybullet
import pybullet_data
import pytest
from pybullet_utils.bullet_client import BulletClient

from tests.solver.solvers import assert_same, needs_packed

pytestmark = needs_packed

SELF_COLLISION = pybullet.URDF_USE_SELF_COLLISION
BOX = {"halfExtents": (0.05, 0.05, 0.05)}


class World:
    """A client of pybullet as a scene of `assert_same`."""

    def __init__(self):
        self.client = BulletClient(pybullet.DIRECT)
        self.client.setGravity(0, 0, -9.81)
        self.bodies = []
        self.drive = lambda k: None

    def ground(self, **dynamics):
        return self.box(0.0, (0, 0, -0.1), (3, 3, 0.1), **dynamics)

    def box(self, mass, position, half_extents=(0.05, 0.05, 0.05), **dynamics):
        shape = self.client.createCollisionShape(
            pybullet.GEOM_BOX, halfExtents=half_extents
        )
        body = self.client.createMultiBody(mass, shape, -1, position)
        if dynamics:
            self.client.changeDynamics(body, -1, **dynamics)
        self.bodies.append(body)
        return body

    def chain(self, num_links, position, *, base_mass=0.0):
        """A chain of hinges whose axes alternate."""
        shape = self.client.createCollisionShape(
            pybullet.GEOM_CAPSULE, radius=0.02, height=0.06
        )
        n = num_links
        axes = [(1, 0, 0) if i % 2 else (0, 1, 0) for i in range(n)]
        body = self.client.createMultiBody(
            base_mass,
            shape,
            -1,
            position,
            linkMasses=[0.1] * n,
            linkCollisionShapeIndices=[shape] * n,
            linkVisualShapeIndices=[-1] * n,
            linkPositions=[(0, 0, -0.12)] * n,
            linkOrientations=[(0, 0, 0, 1)] * n,
            linkInertialFramePositions=[(0, 0, 0)] * n,
            linkInertialFrameOrientations=[(0, 0, 0, 1)] * n,
            linkParentIndices=list(range(n)),
            linkJointTypes=[pybullet.JOINT_REVOLUTE] * n,
            linkJointAxis=axes,
        )
        self.bodies.append(body)
        return body

    def step(self, k):
        self.drive(k)
        self.client.stepSimulation()

    def state(self):
        numbers = []
        for body in self.bodies:
            numbers += [
                *self.client.getBasePositionAndOrientation(body),
                *self.client.getBaseVelocity(body),
            ]
            for joint in range(self.client.getNumJoints(body)):
                position, velocity, reaction, torque = self.client.getJointState(
                    body, joint
                )
                numbers += [(position, velocity, torque), reaction]
        for point in self.client.getContactPoints():
            numbers += [point[5], point[6], point[7], point[8:11], point[12:13]]
        return np.concatenate([np.ravel(number) for number in numbers]).tobytes()


def scene(fill):
    """Build a world with a function that fills it."""

    def build():
        world = World()
        fill(world)
        return world.step, world.state

    return build


def pile(world, **dynamics):
    world.ground(**dynamics)
    for i in range(10):
        x, y = 0.03 * math.sin(3 * i), 0.03 * math.cos(5 * i)
        world.box(0.3 + 0.1 * i, (x, y, 0.06 + 0.11 * i), **dynamics)


@pytest.mark.parametrize(
    "dynamics",
    [
        {},
        {"lateralFriction": 0.0},
        {"lateralFriction": 10.0},
        {"spinningFriction": 0.1},
        {"restitution": 0.9},
    ],
)
def test_ten_cubes_in_a_pile_fall_alike(dynamics):
    assert_same(scene(lambda world: pile(world, **dynamics)), 300)


def test_rolling_friction_acts_alike():
    def fill(world):
        pile(world, rollingFriction=0.05, spinningFriction=0.02)
        shape = world.client.createCollisionShape(pybullet.GEOM_SPHERE, radius=0.05)
        ball = world.client.createMultiBody(0.5, shape, -1, (0.5, 0, 0.05))
        world.client.changeDynamics(ball, -1, rollingFriction=0.05)
        world.client.resetBaseVelocity(ball, (-2, 0.1, 0), (0, 3, 5))
        world.bodies.append(ball)

    assert_same(scene(fill), 200)


@pytest.mark.parametrize(
    "dynamics",
    [
        {"contactStiffness": 1e4, "contactDamping": 50.0},
        {"frictionAnchor": 1},
        {"anisotropicFriction": (1.0, 0.2, 0.1)},
    ],
)
def test_settings_of_contacts_act_alike(dynamics):
    def fill(world):
        pile(world, **dynamics)
        chain = world.chain(5, (1.0, 0, 0.45))
        world.box(0.5, (1.05, 0, 0.05))
        for link in range(-1, 5):
            world.client.changeDynamics(chain, link, **dynamics)

    assert_same(scene(fill), 150, leaves_groups=None)


@pytest.mark.parametrize("masses", [(1e-3, 1e3), (1e3, 1e-3)])
def test_extreme_masses_fall_alike(masses):
    def fill(world):
        world.ground()
        for i in range(6):
            world.box(masses[i % 2], (0.01 * i, 0, 0.06 + 0.1 * i))

    assert_same(scene(fill), 200)


@pytest.mark.parametrize("last_force", [1e280, math.inf, math.nan])
def test_a_diverging_simulation_steps_alike(last_force):
    """If numbers become infinite or NaN, Bullet's function takes over."""

    def fill(world):
        world.ground()
        boxes = [world.box(1.0, (0.3 * i, 0, 0.05)) for i in range(3)]
        chain = world.chain(5, (0.3, 0.3, 0.4))

        def drive(k):
            size = 10.0**k if k < 60 else last_force
            world.client.applyExternalForce(
                boxes[k % 3], -1, (0, 0, -size), (0.01, 0, 0), pybullet.LINK_FRAME
            )
            for joint in range(5):
                world.client.setJointMotorControl2(
                    chain,
                    joint,
                    pybullet.POSITION_CONTROL,
                    targetPosition=size,
                    force=size,
                )

        world.drive = drive

    assert_same(scene(fill), 100, leaves_groups=not math.isfinite(last_force))


@pytest.mark.parametrize(
    "parameters",
    [
        {"enableConeFriction": 0},
        {"numSolverIterations": 1},
        {"numSolverIterations": 7},
        {"solverResidualThreshold": 0.0},
        {"numSubSteps": 4},
        {"useSplitImpulse": 1},
        {"globalCFM": 1e-3},
        {"frictionERP": 0.2},
        {"minimumSolverIslandSize": 1000},
        {"contactERP": 0.5},
    ],
)
def test_engine_parameters_act_alike(parameters):
    def fill(world):
        pile(world, spinningFriction=0.01)
        world.chain(4, (1.0, 0, 0.4))
        world.box(0.5, (1.05, 0, 0.05))
        world.client.setPhysicsEngineParameter(**parameters)

    assert_same(scene(fill), 120)


def test_a_body_in_two_groups_is_left_to_bullet():
    """A box rests on the fixed base of a chain; motors hold the chain's links."""

    def fill(world):
        world.ground()
        chain = world.chain(4, (0, 0, 0.53))
        world.client.resetJointState(chain, 1, 0.6)
        world.box(0.3, (0, 0, 0.6), (0.2, 0.2, 0.01))

    assert_same(scene(fill), 60, leaves_groups=True)


@pytest.mark.parametrize("joint", [pybullet.JOINT_POINT2POINT, pybullet.JOINT_FIXED])
def test_constraints_between_bodies_act_alike(joint):
    def fill(world):
        world.ground()
        world.chain(3, (0, 0, 0.5))
        a = world.box(1.0, (0.3, 0, 0.3))
        b = world.box(1.0, (0.5, 0, 0.3))
        world.client.createConstraint(
            a, -1, b, -1, joint, (0, 0, 1), (0.1, 0, 0), (-0.1, 0, 0)
        )

    assert_same(scene(fill), 150)


def test_a_gear_between_joints_acts_alike():
    def fill(world):
        world.ground()
        chain = world.chain(3, (0, 0, 0.5))
        gear = world.client.createConstraint(
            chain, 0, chain, 2, pybullet.JOINT_GEAR, (0, 0, 1), (0, 0, 0), (0, 0, 0)
        )
        world.client.changeConstraint(gear, gearRatio=-2, maxForce=5)
        world.client.resetJointState(chain, 0, 0.5)

    assert_same(scene(fill), 150)


def test_a_constraint_to_the_world_is_left_to_bullet():
    def fill(world):
        world.ground()
        world.box(1.0, (0.7, 0, 0.3))
        held = world.box(1.0, (0.3, 0, 0.3))
        world.client.createConstraint(
            held, -1, -1, -1, pybullet.JOINT_FIXED, (0, 0, 0), (0, 0, 0), (0.3, 0, 0.5)
        )

    assert_same(scene(fill), 150, leaves_groups=True)


def test_rigid_bodies_are_left_to_bullet():
    def fill(world):
        world.ground()
        shape = world.client.createCollisionShape(pybullet.GEOM_BOX, **BOX)
        for i in range(3):
            body = world.client.createMultiBody(
                1.0, shape, -1, (0.01 * i, 0, 0.06 + 0.11 * i), useMaximalCoordinates=1
            )
            world.bodies.append(body)
        world.box(1.0, (0.02, 0.02, 0.5))

    assert_same(scene(fill), 150, leaves_groups=True)


def test_solver_analytics_are_the_same():
    def fill(world):
        pile(world)
        world.client.setPhysicsEngineParameter(reportSolverAnalytics=1)
        bodies = world.state

        def state():
            return bodies() + repr(world.analytics).encode()

        def step(k):
            world.analytics = world.client.stepSimulation()

        world.state, world.step = state, step

    assert_same(scene(fill), 60)


ROBOTS = (
    "kuka_iiwa/model.urdf",
    "humanoid/humanoid.urdf",
    "aliengo/aliengo.urdf",
    "spherical_joint_limit.urdf",
)


@pytest.mark.parametrize("fixed_base", [False, True])
@pytest.mark.parametrize("robot", ROBOTS)
def test_robots_of_pybullet_move_alike(robot, fixed_base):
    """Floating bases, joints of several degrees of freedom, meshes, self-collisions."""

    def fill(world):
        client = world.client
        client.setAdditionalSearchPath(pybullet_data.getDataPath())
        world.ground()
        world.box(0.5, (0.3, 0.1, 0.05))
        body = client.loadURDF(
            robot, (0, 0, 0.4), useFixedBase=fixed_base, flags=SELF_COLLISION
        )
        world.bodies.append(body)
        generator = np.random.default_rng(0)
        joints = [
            joint
            for joint in range(client.getNumJoints(body))
            if client.getJointInfo(body, joint)[2]
            in (pybullet.JOINT_REVOLUTE, pybullet.JOINT_PRISMATIC)
        ]

        def drive(k):
            if k % 10 == 0:
                for joint in joints:
                    client.setJointMotorControl2(
                        body,
                        joint,
                        pybullet.POSITION_CONTROL,
                        targetPosition=generator.uniform(-2, 2),
                        force=generator.choice([0.0, 1.0, 50.0]),
                    )

        world.drive = drive

    assert_same(scene(fill), 60)
