"""The self-test, which compares Bullet's solver with the replacement in one scene.

An arm of four joints swings into its joint limits and into a stack of two boxes. After
every step, a client asks for the inverse kinematics of one link. Bullet steps the scene
first, while ``probe.c`` checks the layout of Bullet's objects. Then the replacement
steps the same scene in a new client. After every step, both states and both answers
must be equal bit for bit.
"""

from ctypes import c_double, c_float, c_int
from pathlib import Path

from torch_panda.bullet import capi
from torch_panda.bullet.blueprint import Vector
from torch_panda.bullet.body_state import Q_OFFSET, U_OFFSET, BodyState
from torch_panda.bullet.building import ORIGIN, create_body, load_urdf
from torch_panda.bullet.connection import BulletError, Connection, connect, doubles
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
from torch_panda.rotations import NO_ROTATION

_URDF = Path(__file__).with_name("self_test.urdf")
_NUM_STEPS = 60
_TIME_STEP = 0.004
_NUM_ITERATIONS = 40
_RESIDUAL_THRESHOLD = 1e-8
_FORCE = 40.0
_FRICTION = 0.6
_RESTITUTION = 0.3
_MASSES = (0.2, 0.1)  # of the boxes
_KP = 0.3
_KD = 1.0
_GRAVITY = -9.81
_JOINT_DAMPING = 0.2
_DAMPING = c_float(0.04).value  # Bullet's default, linear and angular
_MAX_VELOCITY = 100.0  # Bullet's default
_TABLE_SIZE = 0.5  # half its length
_JOINT_TYPES = (REVOLUTE, REVOLUTE, FIXED, PRISMATIC, PRISMATIC)  # of the arm's links
_LINK_MASSES = (0.7, 0.4, 0.1, 0.05, 0.05)
_NUM_JOINTS = 4
_JOINT_TARGET = 0.8  # lies beyond the limits of all joints
_TARGET = (0.3, 0.1, 0.2, 0.5, 0.5, 0.1, 0.7)  # pose for the inverse kinematics
_IK_DAMPING = 0.02
_IK_ITERATIONS = 6
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
        _TIME_STEP,
        _RESIDUAL_THRESHOLD,
        _FORCE * _TIME_STEP,
        _FRICTION * _FRICTION,
        _RESTITUTION * _RESTITUTION,
        (c_double * 2)(*_MASSES),
        _NUM_ITERATIONS,
        _NUM_JOINTS,
        len(_JOINT_TYPES),
        (c_int * len(_JOINT_TYPES))(*_JOINT_TYPES),
        _KP,
        _KD,
        len(_MASSES) + 2,  # the boxes, the arm and the table
        (c_double * len(_LINK_MASSES))(*_LINK_MASSES),
        _GRAVITY,
        _JOINT_DAMPING,
        _DAMPING,
        _MAX_VELOCITY,
        _TABLE_SIZE,
        (c_double * 7)(*_TARGET),
        _IK_DAMPING,
        _IK_ITERATIONS,
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
        connection = connect()
        try:
            arm, *boxes = _build(connection)
            states = []
            for step in range(_NUM_STEPS):
                if step == _SAVE_STEP:
                    snapshot = _save(connection)
                if step == _LOAD_STEP:
                    _load(connection, snapshot)
                _drive(connection, arm, step)
                connection.submit(
                    capi.step_init(connection.handle),
                    capi.CMD_STEP_FORWARD_SIMULATION_COMPLETED,
                    "step",
                )
                bodies = (_state(connection, body) for body in (arm, *boxes))
                link = step % len(_JOINT_TYPES)
                states.append(b"".join((*bodies, _reach(connection, arm, link))))
            return states
        finally:
            connection.close()
    except BulletError as error:
        raise IncompatibleError(f"the self-test failed: {error}") from None


def _build(connection: Connection) -> list[int]:
    handle = connection.handle
    command = capi.physics_init(handle)
    capi.physics_set_timestep(command, _TIME_STEP)
    capi.physics_set_gravity(command, 0.0, 0.0, _GRAVITY)
    capi.physics_set_solver_iterations(command, _NUM_ITERATIONS)
    capi.physics_set_residual_threshold(command, _RESIDUAL_THRESHOLD)
    connection.submit(command, capi.CMD_CLIENT_COMMAND_COMPLETED, "set parameters")
    arm = load_urdf(
        connection,
        str(_URDF),
        ORIGIN,
        NO_ROTATION,
        fixed_base=True,
        flags=capi.URDF_IGNORE_VISUAL_SHAPES,
    )
    table = _box(connection, 0.0, (_TABLE_SIZE, _TABLE_SIZE, 0.05), (0.0, 0.0, -0.05))
    boxes = [
        _box(connection, _MASSES[0], (0.03, 0.03, 0.03), (0.44, 0.05, 0.03)),
        _box(connection, _MASSES[1], (0.02, 0.03, 0.02), (0.44, 0.05, 0.08)),
    ]
    for body in (arm, table, *boxes):
        for link in range(-1, capi.joint_count(handle, body)):
            command = capi.dynamics_init(handle)
            capi.dynamics_set_lateral_friction(command, body, link, _FRICTION)
            capi.dynamics_set_spinning_friction(command, body, link, 0.1)
            capi.dynamics_set_restitution(command, body, link, _RESTITUTION)
            if body == arm:
                capi.dynamics_set_joint_damping(command, body, link, _JOINT_DAMPING)
            connection.submit(
                command, capi.CMD_CLIENT_COMMAND_COMPLETED, "set dynamics"
            )
    return [arm, *boxes]


def _box(
    connection: Connection, mass: float, half_extents: Vector, position: Vector
) -> int:
    command = capi.shape_init(connection.handle)
    capi.shape_add_box(command, doubles(half_extents))
    status = connection.submit(
        command, capi.CMD_CREATE_COLLISION_SHAPE_COMPLETED, "create a shape"
    )
    shape = int(capi.status_shape(status))
    return create_body(connection, position, mass=mass, collision_shape=shape)


def _drive(connection: Connection, arm: int, step: int) -> None:
    """Drive the joints to their upper limits, and in the second half to the lower."""
    target = _JOINT_TARGET if step < _NUM_STEPS // 2 else -_JOINT_TARGET
    command = capi.motor_init(
        connection.handle, arm, capi.CONTROL_MODE_POSITION_VELOCITY_PD
    )
    for joint in range(_NUM_JOINTS):
        capi.motor_set_position(command, Q_OFFSET + joint, target)
        capi.motor_set_velocity(command, U_OFFSET + joint, 0.0)
        capi.motor_set_kp(command, U_OFFSET + joint, _KP)
        capi.motor_set_kd(command, U_OFFSET + joint, _KD)
        capi.motor_set_force(command, U_OFFSET + joint, _FORCE)
    connection.submit(
        command, capi.CMD_DESIRED_STATE_RECEIVED_COMPLETED, "control joints"
    )


def _save(connection: Connection) -> int:
    status = connection.submit(
        capi.save_init(connection.handle),
        capi.CMD_SAVE_STATE_COMPLETED,
        "save a state",
    )
    return int(capi.status_snapshot(status))


def _load(connection: Connection, snapshot: int) -> None:
    command = capi.load_init(connection.handle)
    capi.load_set_snapshot(command, snapshot)
    connection.submit(command, capi.CMD_RESTORE_STATE_COMPLETED, "load a state")


def _reach(connection: Connection, arm: int, link: int) -> bytes:
    """Bytes of the joint positions that bring a link to the target."""
    command = capi.ik_init(connection.handle, arm)
    capi.ik_set_target(command, link, doubles(_TARGET[:3]), doubles(_TARGET[3:]))
    capi.ik_set_iterations(command, _IK_ITERATIONS)
    capi.ik_set_damping(command, _NUM_JOINTS, doubles((_IK_DAMPING,) * _NUM_JOINTS))
    status = connection.submit(
        command,
        capi.CMD_CALCULATE_INVERSE_KINEMATICS_COMPLETED,
        "solve the inverse kinematics",
    )
    joints = (c_double * _NUM_JOINTS)()
    capi.ik_result(status, c_int(), c_int(), joints)
    return bytes(joints)


def _state(connection: Connection, body: int) -> bytes:
    """Bytes of a body's positions, velocities and motor forces."""
    handle = connection.handle
    state = BodyState(
        connection.submit(
            capi.state_init(handle, body),
            capi.CMD_ACTUAL_STATE_UPDATE_COMPLETED,
            "report a state",
        )
    )
    parts = [
        state.base_pose,
        state.base_velocity,
        state.joint_positions,
        state.joint_velocities,
    ]
    if capi.joint_count(handle, body):
        parts.append(state.motor_forces)
    return b"".join(part.tobytes() for part in parts)
