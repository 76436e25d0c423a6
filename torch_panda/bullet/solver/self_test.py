"""The self-test: a scene with contacts, limits and motors, with and without the solver.

An arm of four joints swings into its limits and into a stack of two boxes. Bullet
steps the scene first, and the layout of its objects is probed. Then the replacement
steps it. All state must be the same, bit for bit, after every step.
"""

from ctypes import c_double, c_int
from pathlib import Path

from torch_panda.bullet import capi
from torch_panda.bullet.body_state import Q_OFFSET, U_OFFSET, BodyState
from torch_panda.bullet.connection import doubles
from torch_panda.bullet.solver.native import (
    FIXED,
    FOLLOW,
    PRISMATIC,
    PROBE,
    REVOLUTE,
    SOLVE,
    Expectation,
    GateError,
    SolverLibrary,
)

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
_JOINT_TYPES = (REVOLUTE, REVOLUTE, FIXED, PRISMATIC, PRISMATIC)  # of the arm's links
_NUM_JOINTS = 4
_JOINT_RANGE = 0.8  # beyond the limits of all joints


def run_self_test(solver: SolverLibrary, *, motor_table: int, limit_table: int) -> None:
    """Probe the layout of Bullet's objects, and compare both solvers.

    Args:
        solver: The replacement, installed but not enabled.
        motor_table: Address of the motors' table of virtual functions.
        limit_table: Address of the joint limits' table of virtual functions.

    Raises:
        GateError: The layout differs, or a bit of the results.
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
    )
    try:
        solver.set_mode(PROBE, expectation)
        expected = _simulate()
        counts = solver.counts()
        if counts.wrong is not None:
            raise GateError(f"Bullet's layout differs: {counts.wrong.decode()}")
        motors = _NUM_JOINTS * _NUM_STEPS
        if counts.joint_rows <= motors or not counts.contact_rows:
            raise GateError("the self-test met no joint limit or no contact")
        solver.set_mode(SOLVE)
        states = _simulate()
        counts = solver.counts()
    finally:
        solver.set_mode(FOLLOW)
    if counts.left or not counts.solved:
        raise GateError("it did not solve all groups of the self-test")
    # Bullet creates the first rows of a joint, and those for which it makes room.
    if counts.created <= counts.not_created or not counts.converted:
        raise GateError("it did not create the rows of the self-test")
    for step, (state, expected_state) in enumerate(zip(states, expected, strict=True)):
        if state != expected_state:
            raise GateError(f"the self-test differs from Bullet in step {step}")


def _simulate() -> list[bytes]:
    """Step the scene in a new client; return the bytes of its state per step."""
    client = capi.connect_direct()
    if not client:
        raise GateError("the self-test could not create a client")
    try:
        arm, *boxes = _build(client)
        states = []
        for step in range(_NUM_STEPS):
            _drive(client, arm, step)
            _submit(client, capi.step_init(client))
            states.append(b"".join(_state(client, body) for body in (arm, *boxes)))
        return states
    finally:
        capi.disconnect(client)


def _submit(client: int, command: int) -> int:
    status = capi.submit(client, command)
    if not status:
        raise GateError("Bullet did not answer the self-test")
    return int(status)


def _build(client: int) -> list[int]:
    command = capi.physics_init(client)
    capi.physics_set_timestep(command, _TIME_STEP)
    capi.physics_set_gravity(command, 0.0, 0.0, -9.81)
    capi.physics_set_solver_iterations(command, _NUM_ITERATIONS)
    capi.physics_set_residual_threshold(command, _RESIDUAL_THRESHOLD)
    _submit(client, command)
    command = capi.urdf_init(client, str(_URDF).encode())
    capi.urdf_set_fixed_base(command, 1)
    capi.urdf_set_flags(command, capi.URDF_IGNORE_VISUAL_SHAPES)
    status = _submit(client, command)
    if capi.status_type(status) != capi.CMD_URDF_LOADING_COMPLETED:
        raise GateError("the self-test could not load its URDF")
    arm = capi.status_body(status)
    table = _box(client, 0.0, (0.5, 0.5, 0.05), (0.0, 0.0, -0.05))
    boxes = [
        _box(client, _MASSES[0], (0.03, 0.03, 0.03), (0.44, 0.05, 0.03)),
        _box(client, _MASSES[1], (0.02, 0.03, 0.02), (0.44, 0.05, 0.08)),
    ]
    for body in (arm, table, *boxes):
        for link in range(-1, capi.joint_count(client, body)):
            command = capi.dynamics_init(client)
            capi.dynamics_set_lateral_friction(command, body, link, _FRICTION)
            capi.dynamics_set_spinning_friction(command, body, link, 0.1)
            capi.dynamics_set_restitution(command, body, link, _RESTITUTION)
            _submit(client, command)
    return [arm, *boxes]


def _box(
    client: int,
    mass: float,
    half_extents: tuple[float, ...],
    position: tuple[float, ...],
) -> int:
    command = capi.shape_init(client)
    capi.shape_add_box(command, doubles(half_extents))
    shape = capi.status_shape(_submit(client, command))
    origin, rotation = doubles((0.0, 0.0, 0.0)), doubles((0.0, 0.0, 0.0, 1.0))
    command = capi.body_init(client)
    capi.body_set_base(
        command, mass, shape, -1, doubles(position), rotation, origin, rotation
    )
    return int(capi.status_body(_submit(client, command)))


def _drive(client: int, arm: int, step: int) -> None:
    """Send the joints to one end of their ranges, later to the other."""
    target = _JOINT_RANGE if step < _NUM_STEPS // 2 else -_JOINT_RANGE
    command = capi.motor_init(client, arm, capi.CONTROL_MODE_POSITION_VELOCITY_PD)
    for joint in range(_NUM_JOINTS):
        capi.motor_set_position(command, Q_OFFSET + joint, target)
        capi.motor_set_velocity(command, U_OFFSET + joint, 0.0)
        capi.motor_set_kp(command, U_OFFSET + joint, _KP)
        capi.motor_set_kd(command, U_OFFSET + joint, _KD)
        capi.motor_set_force(command, U_OFFSET + joint, _FORCE)
    _submit(client, command)


def _state(client: int, body: int) -> bytes:
    """Positions, velocities and forces of motors of a body."""
    state = BodyState(_submit(client, capi.state_init(client, body)))
    parts = [
        state.base_pose,
        state.base_velocity,
        state.joint_positions,
        state.joint_velocities,
    ]
    if capi.joint_count(client, body):
        parts.append(state.motor_forces)
    return b"".join(part.tobytes() for part in parts)
