"""Inverse kinematics with both solvers: equal bits, and who answers which command."""

import math

import numpy as np
import pybullet
import pybullet_data
import pytest
from pybullet_utils.bullet_client import BulletClient

from tests.solver.solvers import needs_packed, solver
from tests.solver.test_scenes import World
from torch_panda.bullet.solver import self_test

pytestmark = needs_packed

FLAGS = pybullet.URDF_IGNORE_VISUAL_SHAPES | pybullet.URDF_IGNORE_COLLISION_SHAPES
# The arm of the self-test has sliding joints, and a branch at its end.
ROBOTS = ("franka_panda/panda.urdf", "kuka_iiwa/model.urdf", str(self_test._URDF))


class Arm:
    """A robot in a client of its own, and random numbers."""

    def __init__(self, urdf=ROBOTS[0], **options):
        self.client = BulletClient(pybullet.DIRECT)
        self.client.setAdditionalSearchPath(pybullet_data.getDataPath())
        self.generator = np.random.default_rng(0)
        self.load(urdf, **options)

    def load(self, urdf=ROBOTS[0], *, fixed_base=True):
        self.body = self.client.loadURDF(urdf, useFixedBase=fixed_base, flags=FLAGS)
        joints = range(self.client.getNumJoints(self.body))
        types = [self.client.getJointInfo(self.body, joint)[2] for joint in joints]
        self.joints = [k for k in joints if types[k] != pybullet.JOINT_FIXED]

    def pose(self, scale):
        orientation = self.generator.normal(size=4)
        orientation /= np.linalg.norm(orientation)
        return self.generator.normal(size=3) * scale, orientation

    def move(self):
        """Move the joints, also beyond their limits."""
        for joint in self.joints:
            position = self.generator.uniform(-4.0, 4.0)
            self.client.resetJointState(self.body, joint, position)

    def reach(self, link=None, *, scale=0.5, **options):
        """The bytes of Bullet's answer. Most of the targets cannot be reached."""
        self.move()
        if link is None:
            link = self.generator.integers(self.client.getNumJoints(self.body))
        position, orientation = self.pose(scale)
        options = {"targetOrientation": orientation, **options}
        if options["targetOrientation"] is None:
            del options["targetOrientation"]
        return np.array(
            self.client.calculateInverseKinematics(self.body, link, position, **options)
        ).tobytes()


def answers(ask, name, **options):
    """Call `ask` with a new arm; return its result and the counts of the library."""
    with solver(name) as library:
        arm = Arm(**options)
        try:
            return ask(arm), library.counts()
        finally:
            arm.client.disconnect()


def assert_same_answers(ask, *, ours, bullet, **options):
    """Assert equal results of `ask`, and how many commands each solver answered."""
    expected, counts = answers(ask, "bullet", **options)
    assert counts.answers == counts.bullet_answers == 0
    results, counts = answers(ask, "packed", **options)
    assert results == expected
    assert (counts.answers, counts.bullet_answers) == (ours, bullet)


@pytest.mark.parametrize("scale", [0.3, 1.0, 100.0])
@pytest.mark.parametrize("urdf", ROBOTS)
def test_random_states_and_targets_have_the_same_answers(urdf, scale):
    def ask(arm):
        damping = arm.generator.uniform(1e-3, 1.0, len(arm.joints))
        return [
            arm.reach(
                scale=scale,
                jointDamping=list(damping),
                maxNumIterations=1 + k % 30,
                residualThreshold=0.03,
            )
            for k in range(300)
        ]

    # The first answer creates Bullet's copy of the robot's frames and axes.
    assert_same_answers(ask, ours=299, bullet=1, urdf=urdf)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"maxNumIterations": 100},
        {"residualThreshold": 0.1},
        {"jointDamping": [0.01] * 9},
    ],
)
def test_commands_that_leave_out_options_have_the_same_answers(options):
    def ask(arm):
        return [arm.reach(**options) for _ in range(50)]

    assert_same_answers(ask, ours=49, bullet=1)


def test_nearly_reached_targets_have_the_same_answers():
    """The orientation's error is close to 0, or close to a full turn."""

    def ask(arm):
        arm.reach()
        results = []
        for sign in (1, -1):
            arm.move()
            state = arm.client.getLinkState(arm.body, 11, computeForwardKinematics=True)
            orientation = [sign * number for number in state[1]]
            for _ in range(10):
                joints = arm.client.calculateInverseKinematics(
                    arm.body, 11, state[0], orientation, maxNumIterations=3
                )
                results.append(joints)
                for joint, position in zip(arm.joints, joints, strict=True):
                    arm.client.resetJointState(arm.body, joint, position)
        return results

    assert_same_answers(ask, ours=20, bullet=1)


def test_a_turned_and_moved_base_has_the_same_answers():
    def ask(arm):
        results = []
        for _ in range(50):
            arm.client.resetBasePositionAndOrientation(arm.body, *arm.pose(2.0))
            results.append(arm.reach(11, scale=2.0))
        return results

    assert_same_answers(ask, ours=49, bullet=1)


def test_later_commands_of_bullet_have_the_same_answers():
    """Bullet computes other things with the numbers that both solvers read."""

    def ask(arm):
        results = []
        for k in range(20):
            results.append(arm.reach(11))
            joints = list(arm.generator.uniform(-1.0, 1.0, 9))
            zeros = [0.0] * 9
            results += [
                arm.client.calculateMassMatrix(arm.body, joints),
                arm.client.calculateInverseDynamics(arm.body, joints, joints, zeros),
                arm.client.calculateJacobian(
                    arm.body, k % 11, (0.1, 0.0, 0.2), joints, joints, zeros
                ),
                arm.client.calculateInverseKinematics(arm.body, 11, (0.3, 0.1, 0.5)),
            ]
        return results

    assert_same_answers(ask, ours=19, bullet=21)


def test_a_robot_that_is_loaded_again_has_the_same_answers():
    """Bullet keeps the frames and axes of a body that was removed.

    It uses them for a new body with the same address, which depends on the allocator.
    """

    def ask(arm):
        results = []
        for _ in range(12):
            arm.client.removeBody(arm.body)
            arm.load()
            results += [arm.reach(11) for _ in range(3)]
        arm.client.resetSimulation()
        arm.load()
        return results + [arm.reach(11) for _ in range(3)]

    expected, _ = answers(ask, "bullet")
    results, counts = answers(ask, "packed")
    assert results == expected
    assert counts.answers >= 26


LIMITS = {
    "lowerLimits": [-3.0] * 9,
    "upperLimits": [3.0] * 9,
    "jointRanges": [6.0] * 9,
    "restPoses": [0.1] * 9,
}


@pytest.mark.parametrize(
    "options",
    [
        {"targetOrientation": None},
        {"currentPositions": [0.1] * 9},
        LIMITS,
        {"targetOrientation": (0.0, 0.0, 0.0, 0.0)},
        {"targetOrientation": (math.nan, 0.0, 0.0, 1.0)},
        {"jointDamping": [math.nan] * 9},
    ],
)
def test_other_options_and_bad_numbers_are_left_to_bullet(options):
    def ask(arm):
        return [arm.reach(11, **options) for _ in range(3)]

    assert_same_answers(ask, ours=0, bullet=3)


def test_commands_of_a_client_that_logs_them_are_left_to_bullet(tmp_path):
    def ask(arm):
        file = str(tmp_path / "commands.bin")
        log = arm.client.startStateLogging(pybullet.STATE_LOGGING_ALL_COMMANDS, file)
        results = [arm.reach(11) for _ in range(3)]
        arm.client.stopStateLogging(log)
        return results + [arm.reach(11) for _ in range(3)]

    assert_same_answers(ask, ours=3, bullet=3)


def test_kinematics_of_a_floating_base_are_left_to_bullet():
    def ask(arm):
        return [arm.reach(11) for _ in range(3)]

    assert_same_answers(ask, ours=0, bullet=3, fixed_base=False)


@pytest.mark.parametrize(("num_joints", "ours"), [(32, 2), (33, 0)])
def test_a_robot_of_more_than_32_joints_is_left_to_bullet(num_joints, ours):
    def ask(arm):
        world = World()
        world.client = arm.client
        arm.body, arm.joints = world.chain(num_joints, (0, 0, 0)), range(num_joints)
        return [arm.reach() for _ in range(3)]

    assert_same_answers(ask, ours=ours, bullet=3 - ours)
