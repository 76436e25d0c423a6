"""The self-test, which compares Bullet's solver with the replacement in one scene.

An arm of four joints swings into its joint limits and into a stack of two boxes. After
every step, a client asks for the inverse kinematics of one link. Bullet steps the scene
first, while ``probe.c`` checks the layout of Bullet's objects. Then the replacement
steps the same scene in a new client. After every step, both states and both answers
must be equal bit for bit.
"""

from ctypes import c_double, c_float, c_int
from pathlib import Path

import numpy as np

from torch_panda.bullet import capi
from torch_panda.bullet.client import VELOCITY_GAIN, PhysicsClient
from torch_panda.bullet.connection import BulletError
from torch_panda.bullet.physics import PhysicsParams
from torch_panda.bullet.solver.native import (
    FIXED,
    FOLLOW,
    PRISMATIC,
    PROBE,
    REVOLUTE,
    SOLVE,
    Expectation,
    IncompatibleError,
    SolverLibrary,
)

_URDF = Path(__file__).with_name("self_test.urdf")
_NUM_STEPS = 60
_PHYSICS = PhysicsParams(
    timestep=0.004,
    solver_iterations=40,
    residual_threshold=1e-8,
    position_gain=0.3,
    ik_iterations=6,
    ik_damping=0.02,
)
_FORCE = 40.0
_FRICTION = 0.6
_RESTITUTION = 0.3
_MASSES = (0.2, 0.1)  # of the boxes
_BOXES = ((0.03, 0.03, 0.03), (0.02, 0.03, 0.02))  # half their edges
_JOINT_DAMPING = 0.2
_DAMPING = c_float(0.04).value  # Bullet's default, linear and angular
_MAX_VELOCITY = 100.0  # Bullet's default
_TABLE_SIZE = 0.5  # half its length
_JOINT_TYPES = (REVOLUTE, REVOLUTE, FIXED, PRISMATIC, PRISMATIC)  # of the arm's links
_LINK_MASSES = (0.7, 0.4, 0.1, 0.05, 0.05)
_NUM_JOINTS = 4
_JOINT_TARGET = 0.8  # lies beyond the limits of all joints
_TARGET = (0.3, 0.1, 0.2, 0.5, 0.5, 0.1, 0.7)  # pose for the inverse kinematics
_SAVE_STEP, _LOAD_STEP = 20, 40  # before which a snapshot is taken and loaded


def run_self_test(solver: SolverLibrary, *, motor_table: int, limit_table: int) -> None:
    """Probe the layout of Bullet's objects, and compare both solvers.

    Args:
        solver: The replacement, installed but not enabled.
        motor_table: Address of the motors' table of virtual functions.
        limit_table: Address of the joint limits' table of virtual functions.

    Raises:
        IncompatibleError: The layout of Bullet's objects or any bit of a state differs.
    """
    expectation = Expectation(
        motor_table,
        limit_table,
        _PHYSICS.timestep,
        _PHYSICS.residual_threshold,
        _FORCE * _PHYSICS.timestep,
        _FRICTION * _FRICTION,
        _RESTITUTION * _RESTITUTION,
        (c_double * 2)(*_MASSES),
        _PHYSICS.solver_iterations,
        _NUM_JOINTS,
        len(_JOINT_TYPES),
        (c_int * len(_JOINT_TYPES))(*_JOINT_TYPES),
        _PHYSICS.position_gain,
        VELOCITY_GAIN,
        len(_MASSES) + 2,  # the boxes, the arm and the table
        (c_double * len(_LINK_MASSES))(*_LINK_MASSES),
        _PHYSICS.gravity,
        _JOINT_DAMPING,
        _DAMPING,
        _MAX_VELOCITY,
        _TABLE_SIZE,
        (c_double * 7)(*_TARGET),
        _PHYSICS.ik_damping,
        _PHYSICS.ik_iterations,
    )
    try:
        solver.set_mode(PROBE, expectation)
        expected = _simulate()
        counts = solver.counts()
        if counts.mismatch is not None:
            raise IncompatibleError(
                f"Bullet's layout differs: {counts.mismatch.decode()}"
            )
        motors = _NUM_JOINTS * _NUM_STEPS
        if counts.joint_rows <= motors or not counts.contact_rows:
            raise IncompatibleError(
                "the scene of the self-test has no joint limit or no contact"
            )
        solver.set_mode(SOLVE)
        states = _simulate()
        counts = solver.counts()
    finally:
        solver.set_mode(FOLLOW)
    if counts.bullet_groups or not counts.groups:
        raise IncompatibleError(
            "the packed solver did not solve all groups of the self-test"
        )
    # Bullet still creates some rows: the first rows of a joint, and rows for which it
    # must enlarge an array.
    if counts.joints <= counts.bullet_joints or not counts.manifolds:
        raise IncompatibleError(
            "the packed solver did not create the rows of the self-test"
        )
    if counts.bodies != _NUM_STEPS:
        raise IncompatibleError(
            "the packed solver did not compute the accelerations of the self-test"
        )
    # The first of Bullet's answers creates numbers that the replacement reads.
    if (counts.answers, counts.bullet_answers) != (_NUM_STEPS - 1, 1):
        raise IncompatibleError(
            "the packed solver did not compute the inverse kinematics of the self-test"
        )
    if (counts.snapshots, counts.bullet_snapshots) != (1, 0):
        raise IncompatibleError("the snapshot of the self-test has collision shapes")
    if not counts.aabbs:
        raise IncompatibleError(
            "the packed solver did not move the AABBs of the self-test"
        )
    for step, (state, expected_state) in enumerate(zip(states, expected, strict=True)):
        if state != expected_state:
            raise IncompatibleError(f"the self-test differs from Bullet in step {step}")


def _simulate() -> list[bytes]:
    """Step the scene in a new client; return the bytes of the state after each step."""
    try:
        with PhysicsClient(physics=_PHYSICS, is_self_test=True) as client:
            arm, *boxes = _build(client)
            states = []
            for step in range(_NUM_STEPS):
                if step == _SAVE_STEP:
                    snapshot = client.save()
                if step == _LOAD_STEP:
                    _load(client, snapshot)
                # Drive the joints to their upper limits, and later to the lower ones.
                target = _JOINT_TARGET if step < _NUM_STEPS // 2 else -_JOINT_TARGET
                targets = np.full(_NUM_JOINTS, target)
                client.control_joints(arm, targets, (_FORCE,) * _NUM_JOINTS)
                client.step()
                state = b"".join(_state(client, body) for body in (arm, *boxes))
                answer = np.empty(_NUM_JOINTS)
                client.inverse_kinematics(
                    arm,
                    step % len(_JOINT_TYPES),
                    np.array(_TARGET[:3]),
                    _TARGET[3:],
                    answer,
                )
                states.append(state + answer.tobytes())
            return states
    except BulletError as error:
        raise IncompatibleError(f"the self-test failed: {error}") from None


def _build(client: PhysicsClient) -> list[int]:
    arm = client.load_urdf(_URDF, fixed_base=True)
    table = client.create_box(
        (_TABLE_SIZE, _TABLE_SIZE, 0.05), mass=0.0, position=(0.0, 0.0, -0.05)
    )
    boxes = [
        client.create_box(size, mass=mass, position=(0.44, 0.05, height))
        for size, mass, height in zip(_BOXES, _MASSES, (0.03, 0.08), strict=True)
    ]
    for body in (arm, table, *boxes):
        for link in range(-1, len(client.joints(body))):
            client.set_dynamics(
                body,
                link,
                lateral_friction=_FRICTION,
                spinning_friction=0.1,
                restitution=_RESTITUTION,
                joint_damping=_JOINT_DAMPING if body == arm else None,
            )
    return [arm, *boxes]


def _load(client: PhysicsClient, snapshot: int) -> None:
    command = capi.load_init(client.connection.handle)
    capi.load_set_snapshot(command, snapshot)
    client.connection.submit(command, capi.CMD_RESTORE_STATE_COMPLETED, "load a state")


def _state(client: PhysicsClient, body: int) -> bytes:
    """Bytes of a body's positions, velocities and motor forces."""
    state = client.state(body)
    parts = [
        state.base_pose,
        state.base_velocity,
        state.joint_positions,
        state.joint_velocities,
    ]
    if client.joints(body):
        parts.append(state.motor_forces)
    return b"".join(part.tobytes() for part in parts)
