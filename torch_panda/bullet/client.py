"""One DIRECT physics client of Bullet."""

import importlib.util
import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from ctypes import Array, byref, c_double, c_int, c_size_t, c_void_p
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from torch_panda.bullet import _capi
from torch_panda.bullet.contacts import ContactPoint, read_contact
from torch_panda.bullet.physics import EXACT, PhysicsParams
from torch_panda.bullet.shapes import Box, Cylinder, Look, Shape, Sphere
from torch_panda.closing import Closing

_MAX_DOF = _capi.MAX_MULTI_DOF
# pybullet's default for setJointMotorControlArray(POSITION_CONTROL).
_KD = (c_double * _MAX_DOF)(*[1.0] * _MAX_DOF)
# Joints follow the base in Bullet's coordinates: 7 of its pose, 6 of its velocity.
_Q_OFFSET = 7
_U_OFFSET = 6

_DOUBLE = 8  # bytes

_ORIGIN = (0.0, 0.0, 0.0)
_NO_ROTATION = (0.0, 0.0, 0.0, 1.0)


class BulletError(RuntimeError):
    """Bullet refused a command, or a simulation was used after ``close``."""


@dataclass(frozen=True)
class Joint:
    """A joint of a body, as its URDF describes it."""

    index: int
    name: str
    link_name: str
    is_movable: bool


class JointForces(NamedTuple):
    """Addresses of the forces at a body's joints in the last step.

    They are valid until the client's next command, and arrays of doubles for m joints,
    fixed ones included:

    Attributes:
        wrenches: (m, 6), what each link's parent exerts on it, force [N] and torque
            [N m], at the joint and in the link's frame; zero without a sensor.
        motor_forces: (m,), what each motor exerts [N m] or [N].
    """

    wrenches: int
    motor_forces: int

    def wrench(self, joint: int) -> int:
        """Address of the wrench (6) at a joint."""
        return self.wrenches + _DOUBLE * 6 * joint


class BodyState(NamedTuple):
    """Addresses of the state of a body, valid until the client's next command.

    All are arrays of doubles in the world frame, with n joints of one degree of
    freedom and m links:

    Attributes:
        q: base pose (7: position [m], quaternion xyzw), then n joint positions.
        u: base velocity (6: linear [m/s], angular [rad/s]), then n joint velocities.
        link_poses: (m, 7), of the centres of mass.
        link_velocities: (m, 6), filled only if they were asked for.
    """

    q: int
    u: int
    link_poses: int
    link_velocities: int

    @property
    def joint_positions(self) -> int:
        """Address of the n joint positions [rad] or [m]."""
        return self.q + _DOUBLE * _Q_OFFSET

    @property
    def joint_velocities(self) -> int:
        """Address of the n joint velocities [rad/s] or [m/s]."""
        return self.u + _DOUBLE * _U_OFFSET

    def link_pose(self, link: int) -> int:
        """Address of the pose (7) of a link."""
        return self.link_poses + _DOUBLE * 7 * link

    def link_velocity(self, link: int) -> int:
        """Address of the velocity (6) of a link."""
        return self.link_velocities + _DOUBLE * 6 * link


def doubles(values: Sequence[float]) -> Array[c_double]:
    """A C array of doubles."""
    return (c_double * len(values))(*values)


def read_doubles(address: int, count: int) -> tuple[float, ...]:
    """The doubles at an address."""
    return tuple((c_double * count).from_address(address))


def find_urdf(path: str | Path) -> str:
    """A URDF file by its path, or by its place among those pybullet ships.

    Raises:
        FileNotFoundError: there is no such file in either place.
    """
    spec = importlib.util.find_spec("pybullet_data")
    assert spec is not None and spec.origin is not None  # part of pybullet's wheel
    shipped = Path(spec.origin).parent
    for candidate in (Path(path), shipped / path):
        if candidate.is_file():
            return str(candidate)
    raise FileNotFoundError(f"no URDF file at {path}, nor at {shipped / path}")


def _check_not_negative(**values: float | None) -> None:
    for name, value in values.items():
        if value is not None and not 0 <= value < math.inf:
            raise ValueError(f"{name} must be finite and at least 0, got {value}")


def _check_collision_filters(file: str) -> None:
    """Raise ValueError if a URDF chooses its own collision groups or masks."""
    try:
        tree = ElementTree.parse(file)
    except ElementTree.ParseError:
        return  # Bullet says what is wrong
    for shape in tree.iter("collision"):
        chosen = {"group", "mask"} & set(shape.attrib)
        if chosen:
            raise ValueError(
                f"the collision shapes of a URDF must not have a group or a mask, "
                f"got {sorted(chosen)} in {file}"
            )


class PhysicsClient(Closing):
    """One DIRECT client: a world of bodies, and the owner of its handle.

    A client must be used by one thread at a time. Clients of one process are
    independent: in different threads they step in parallel.

    Methods that run in every step take and give addresses of doubles, for instance
    of a row of a float64 tensor, so that no number passes through a Python object.

    Nothing is drawn here: looks are for a `VisualClient`, in which the same calls build
    the same bodies to be seen.

    Args:
        physics: how it integrates.

    Raises:
        ImportError: the installed pybullet has another C API.
    """

    _urdf_flags = _capi.URDF_IGNORE_VISUAL_SHAPES

    def __init__(self, *, physics: PhysicsParams = EXACT) -> None:
        self._bodies: list[int] = []
        self._num_detections = 0
        self._handle: int | None = self._connect()
        if not self._handle:
            raise BulletError("Bullet could not create a client")
        # The last status code in use: it moves when another version adds one before.
        try:
            self.detect_collisions()
        except BulletError as error:
            self.close()
            raise _capi.wrong_pybullet(f"its status codes differ: {error}") from None
        command = _capi.physics_init(self._handle)
        _capi.physics_set_timestep(command, physics.timestep)
        _capi.physics_set_gravity(command, 0.0, 0.0, physics.gravity)
        _capi.physics_set_solver_iterations(command, physics.solver_iterations)
        _capi.physics_set_residual_threshold(command, physics.residual_threshold)
        self._submit(command, _capi.CMD_CLIENT_COMMAND_COMPLETED, "set parameters")
        self._kp = doubles([physics.position_gain] * _MAX_DOF)

    def _connect(self) -> int | None:
        """Make a world, and return the handle by which Bullet knows the client."""
        handle: int | None = _capi.connect_direct()
        return handle

    @property
    def is_closed(self) -> bool:
        """Whether the world is gone."""
        return self._handle is None

    @property
    def bodies(self) -> tuple[int, ...]:
        """Ids of the bodies, in the order in which they were built."""
        return tuple(self._bodies)

    @property
    def num_detections(self) -> int:
        """How often collisions have been detected; every time step does."""
        return self._num_detections

    def close(self) -> None:
        """Free the world. Closing again does nothing."""
        if self._handle is not None:
            _capi.disconnect(self._handle)
            self._handle = None

    def __reduce__(self) -> "tuple[object, ...]":
        raise TypeError("a PhysicsClient owns native memory and cannot be pickled")

    # ---- building a world --------------------------------------------------------

    def load_urdf(
        self,
        path: str | Path,
        *,
        position: Sequence[float] = _ORIGIN,
        orientation: Sequence[float] = _NO_ROTATION,
        fixed_base: bool = False,
    ) -> int:
        """Load a URDF, here without its visual shapes, and return its body id.

        Args:
            path: a file, or a name among those that pybullet ships.
            position: of the base, world frame [m].
            orientation: of the base, quaternion xyzw.
            fixed_base: whether the base cannot move.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it chooses its own collision groups or masks, which Bullet does
                not report and `set_collision_filter` could therefore not restore.
            BulletError: Bullet cannot read it.
        """
        file = find_urdf(path)
        _check_collision_filters(file)
        command = _capi.urdf_init(self._open(), file.encode())
        _capi.urdf_set_position(command, *position)
        _capi.urdf_set_orientation(command, *orientation)
        _capi.urdf_set_fixed_base(command, int(fixed_base))
        _capi.urdf_set_flags(command, self._urdf_flags)
        status = self._submit(command, _capi.CMD_URDF_LOADING_COMPLETED, f"load {path}")
        return self._add_body(status)

    def create_box(
        self,
        half_extents: Sequence[float],
        *,
        mass: float,
        position: Sequence[float],
        look: Look = Look(),  # noqa: B008 (frozen)
    ) -> int:
        """Create a box and return its body id.

        Args:
            half_extents: along x, y and z [m].
            mass: [kg]; 0 makes a body that never moves.
            position: of its centre, world frame [m].
            look: how a `VisualClient` draws it.
        """
        x, y, z = half_extents
        return self._create_body(Box((x, y, z)), mass, position, look)

    def create_cylinder(
        self,
        radius: float,
        height: float,
        *,
        mass: float,
        position: Sequence[float],
        look: Look = Look(),  # noqa: B008 (frozen)
    ) -> int:
        """Create an upright cylinder and return its body id; see `create_box`."""
        return self._create_body(Cylinder(radius, height), mass, position, look)

    def create_sphere(
        self,
        radius: float,
        *,
        mass: float,
        position: Sequence[float],
        look: Look = Look(),  # noqa: B008 (frozen)
    ) -> int:
        """Create a sphere and return its body id; see `create_box`."""
        return self._create_body(Sphere(radius), mass, position, look)

    def create_marker(
        self,
        position: Sequence[float],
        shape: Shape | None = None,
        *,
        look: Look = Look(),  # noqa: B008 (frozen)
    ) -> int:
        """Create a body that nothing touches, and return its id.

        Args:
            position: world frame [m].
            shape: what a `VisualClient` draws, translucent; None: nothing.
            look: how it draws it.
        """
        return self._create_body(shape, 0.0, position, look, is_marker=True)

    def set_friction(
        self,
        body: int,
        link: int = -1,
        *,
        lateral: float | None = None,
        spinning: float | None = None,
    ) -> None:
        """Set friction coefficients of a link (-1 is the base); None leaves one.

        Raises:
            ValueError: one is negative or not finite.
        """
        _check_not_negative(lateral_friction=lateral, spinning_friction=spinning)
        command = _capi.dynamics_init(self._open())
        if lateral is not None:
            _capi.dynamics_set_lateral_friction(command, body, link, lateral)
        if spinning is not None:
            _capi.dynamics_set_spinning_friction(command, body, link, spinning)
        self._submit(command, _capi.CMD_CLIENT_COMMAND_COMPLETED, "set friction")

    def set_collision_filter(self, body: int, link: int, group: int, mask: int) -> None:
        """Choose what a link (-1 is the base) touches, and forget what it touched.

        Two links touch if the group of either has a bit of the other's mask. The link
        enters Bullet's broad phase anew: without its overlaps and contacts so far, and
        as the last of all links.
        """
        command = _capi.filter_init(self._open())
        _capi.filter_set_group_mask(command, body, link, group, mask)
        self._submit(
            command, _capi.CMD_CLIENT_COMMAND_COMPLETED, "set a collision filter"
        )

    def mass(self, body: int, link: int = -1) -> float:
        """Mass of a link (-1 is the base) [kg]; 0 for a base that cannot move."""
        return float(self._dynamics(body, link).mass)

    def centre_of_mass(self, body: int, link: int = -1) -> tuple[float, ...]:
        """Centre of mass of a link (-1 is the base) in the frame of its URDF [m]."""
        return tuple(self._dynamics(body, link).local_inertial_frame[:3])

    def _dynamics(self, body: int, link: int) -> _capi.DynamicsInfo:
        command = _capi.dynamics_info_init(self._open(), body, link)
        status = self._submit(
            command, _capi.CMD_GET_DYNAMICS_INFO_COMPLETED, "report dynamics"
        )
        info = _capi.DynamicsInfo()
        _capi.dynamics_info(status, byref(info))
        return info

    def joints(self, body: int) -> list[Joint]:
        """The joints of a body, in the order of its URDF."""
        handle = self._open()
        info = _capi.JointInfo()
        joints = []
        for index in range(_capi.joint_count(handle, body)):
            _capi.joint_info(handle, body, index, byref(info))
            name, link = info.joint_name.decode(), info.link_name.decode()
            joints.append(Joint(index, name, link, info.u_size == 1))
        return joints

    # ---- moving it ---------------------------------------------------------------

    def set_joint(
        self, body: int, joint: int, position: float, velocity: float
    ) -> None:
        """Put a joint at a position [rad] or [m], with a velocity [rad/s] or [m/s]."""
        self.set_joints(body, (joint,), (position,), (velocity,))

    def set_joints(
        self,
        body: int,
        joints: Sequence[int],
        positions: Sequence[float],
        velocities: Sequence[float],
    ) -> None:
        """Put several joints somewhere at once; see `set_joint`."""
        command = _capi.pose_init(self._open(), body)
        for joint, position, velocity in zip(
            joints, positions, velocities, strict=True
        ):
            _capi.pose_set_joint_position(self._handle, command, joint, position)
            _capi.pose_set_joint_velocity(self._handle, command, joint, velocity)
        self._submit(command, _capi.CMD_CLIENT_COMMAND_COMPLETED, "set joints")

    def set_base(
        self,
        body: int,
        position: Sequence[float],
        orientation: Sequence[float] = _NO_ROTATION,
        linear_velocity: Sequence[float] = _ORIGIN,
        angular_velocity: Sequence[float] = _ORIGIN,
    ) -> None:
        """Put a body somewhere, with a velocity, in the world frame.

        Args:
            body: the body.
            position: of its centre of mass [m].
            orientation: quaternion xyzw.
            linear_velocity: [m/s].
            angular_velocity: [rad/s].
        """
        command = _capi.pose_init(self._open(), body)
        _capi.pose_set_linear_velocity(command, doubles(linear_velocity))
        _capi.pose_set_angular_velocity(command, doubles(angular_velocity))
        _capi.pose_set_position(command, *position)
        _capi.pose_set_orientation(command, *orientation)
        self._submit(command, _capi.CMD_CLIENT_COMMAND_COMPLETED, "set a base pose")

    def save(self) -> int:
        """Take a snapshot of all poses, velocities and contacts; return its id."""
        command = _capi.save_init(self._open())
        status = self._submit(command, _capi.CMD_SAVE_STATE_COMPLETED, "save a state")
        return int(_capi.status_snapshot(status))

    def load(self, snapshot: int) -> None:
        """Put everything where it was in a snapshot that was taken without contacts.

        Other than `set_base` it leaves the links' boxes, from which Bullet's broad
        phase finds overlaps, where they are until the next collision detection.
        """
        command = _capi.load_init(self._open())
        _capi.load_set_snapshot(command, snapshot)
        self._submit(command, _capi.CMD_RESTORE_STATE_COMPLETED, "load a state")

    def control_joints(self, body: int, targets: int, forces: Array[c_double]) -> None:
        """Drive all movable joints to target positions.

        Does what pybullet's ``setJointMotorControlArray`` does in position control,
        with the position gain of the client's physics. The target velocity that it
        sets is Bullet's default, 0.

        Args:
            body: the body.
            targets: address of as many target positions as there are forces.
            forces: the most each motor may exert [N m] or [N].
        """
        command = _capi.motor_init(
            self._open(), body, _capi.CONTROL_MODE_POSITION_VELOCITY_PD
        )
        for first in range(0, len(forces), _MAX_DOF):
            count = min(_MAX_DOF, len(forces) - first)
            q, u = first + _Q_OFFSET, first + _U_OFFSET
            _capi.motor_set_positions(command, q, targets + _DOUBLE * first, count)
            _capi.motor_set_kp(command, u, self._kp, count)
            _capi.motor_set_kd(command, u, _KD, count)
            _capi.motor_set_forces(command, u, byref(forces, _DOUBLE * first), count)
        # Bullet only takes notes: done before another thread could use the GIL.
        status = _capi.submit_quick(self._open(), command)
        self._check(
            status, _capi.CMD_DESIRED_STATE_RECEIVED_COMPLETED, "control joints"
        )

    def step(self, count: int = 1) -> None:
        """Advance the world by ``count`` time steps."""
        handle = self._open()
        command = _capi.step_init(handle)
        # A client has one command buffer, and stepping leaves it as it was: submitting
        # it again steps again.
        self._num_detections += count
        failed = _capi.repeat(handle, command, byref(c_size_t(count)), 0, _capi.submit)
        if failed:
            raise BulletError("Bullet could not step: it gave no answer")

    def detect_collisions(self, count: int = 1) -> None:
        """Run collision detection ``count`` times without advancing time."""
        if count < 1:
            return
        handle = self._open()
        command = _capi.detect_init(handle)
        self._num_detections += count
        # As in `step`; the last one's answer is checked.
        _capi.repeat(handle, command, byref(c_size_t(count - 1)), 0, _capi.submit)
        self._submit(
            command,
            _capi.CMD_PERFORM_COLLISION_DETECTION_COMPLETED,
            "detect collisions",
        )

    # ---- asking it ---------------------------------------------------------------

    def inverse_kinematics(
        self, body: int, link: int, position: int, orientation: int, result: int
    ) -> None:
        """Joint positions that bring a link to a pose, by damped least squares.

        The default solver, because the others share a static work vector.

        Args:
            body: the body.
            link: whose centre of mass is to be moved.
            position: address of the target position (3), world frame [m].
            orientation: address of the target quaternion (4), xyzw.
            result: address that receives one position per movable joint.
        """
        command = _capi.ik_init(self._open(), body)
        _capi.ik_set_target(command, link, position, orientation)
        status = self._submit(
            command,
            _capi.CMD_CALCULATE_INVERSE_KINEMATICS_COMPLETED,
            "solve the inverse kinematics",
        )
        _capi.ik_result(status, byref(c_int()), byref(c_int()), result)

    def state(self, body: int, *, link_velocities: bool = False) -> BodyState:
        """The state of a body's base, joints and links."""
        command = _capi.state_init(self._open(), body)
        if link_velocities:
            _capi.state_want_link_velocity(command, 1)
        status = self._submit(
            command, _capi.CMD_ACTUAL_STATE_UPDATE_COMPLETED, "report a state"
        )
        q, u, poses, velocities = c_void_p(), c_void_p(), c_void_p(), c_void_p()
        _capi.state_result(
            status,
            None,
            None,
            None,
            None,
            None,
            byref(q),
            byref(u),
            None,
            None,
            None,
            byref(poses),
            byref(velocities),
        )
        return BodyState(q.value, u.value, poses.value, velocities.value)  # type: ignore[arg-type]

    def enable_wrench_sensor(self, body: int, joint: int) -> None:
        """Have the forces through a joint computed in every step."""
        command = _capi.physics_init(self._open())
        _capi.physics_set_joint_feedback(command, _capi.JOINT_FEEDBACK_IN_JOINT_FRAME)
        self._submit(command, _capi.CMD_CLIENT_COMMAND_COMPLETED, "set parameters")
        command = _capi.sensor_init(self._open(), body)
        _capi.sensor_enable_wrench(command, joint, 1)
        self._submit(command, _capi.CMD_CLIENT_COMMAND_COMPLETED, "add a sensor")

    def joint_forces(self, body: int) -> JointForces:
        """The forces at a body's joints in the last step."""
        command = _capi.state_init(self._open(), body)
        status = self._submit(
            command, _capi.CMD_ACTUAL_STATE_UPDATE_COMPLETED, "report a state"
        )
        wrenches, motors = c_void_p(), c_void_p()
        _capi.state_result(
            status,
            None,
            None,
            None,
            None,
            None,
            None,
            None,
            byref(wrenches),
            None,
            byref(motors),
            None,
            None,
        )
        return JointForces(wrenches.value, motors.value)  # type: ignore[arg-type]

    def contact_points(
        self, body_a: int | None = None, body_b: int | None = None
    ) -> list[ContactPoint]:
        """Contacts of the last step, of all bodies or of those given."""
        # Not filtered by Bullet, which would swap a and b but not the friction.
        command = _capi.contact_init(self._open())
        self._submit(
            command, _capi.CMD_CONTACT_POINT_INFORMATION_COMPLETED, "report contacts"
        )
        found = _capi.ContactInformation()
        _capi.contact_result(self._handle, byref(found))
        points = []
        for point in found.points[: found.count]:
            contact = read_contact(point)
            if body_a not in (None, contact.body_a):
                contact = contact.swapped()
            if body_a in (None, contact.body_a) and body_b in (None, contact.body_b):
                points.append(contact)
        return points

    # ---- commands ----------------------------------------------------------------

    def _open(self) -> int:
        if self._handle is None:
            raise BulletError("the physics client is closed")
        return self._handle

    def _submit(self, command: int, expected: int, action: str) -> int:
        status = _capi.submit(self._open(), command)
        self._check(status, expected, action)
        return status

    def _check(self, status: int | None, expected: int, action: str) -> None:
        """Raise unless Bullet answered with the expected status code."""
        code = _capi.status_type(status) if status else None
        if code != expected:
            raise BulletError(
                f"Bullet could not {action}: it answered with status {code}, "
                f"expected {expected}"
            )

    def _create_body(
        self,
        shape: Shape | None,
        mass: float,
        position: Sequence[float],
        look: Look,
        *,
        is_marker: bool = False,
    ) -> int:
        _check_not_negative(mass=mass)
        collision = visual = -1
        if shape is not None:
            visual = self._create_visual_shape(shape, look, is_marker=is_marker)
            if not is_marker:
                collision = self._create_collision_shape(shape)
        rotation, origin = doubles(_NO_ROTATION), doubles(_ORIGIN)
        command = _capi.body_init(self._open())
        _capi.body_set_base(
            command,
            mass,
            collision,
            visual,
            doubles(position),
            rotation,
            origin,
            rotation,
        )
        status = self._submit(
            command, _capi.CMD_CREATE_MULTI_BODY_COMPLETED, "create a body"
        )
        return self._add_body(status)

    def _add_body(self, status: int) -> int:
        body: int = _capi.status_body(status)
        self._bodies.append(body)
        return body

    def _create_collision_shape(self, shape: Shape) -> int:
        command = _capi.shape_init(self._open())
        match shape:
            case Box(half_extents):
                _capi.shape_add_box(command, doubles(half_extents))
            case Cylinder(radius, height):
                _capi.shape_add_cylinder(command, radius, height)
            case Sphere(radius):
                _capi.shape_add_sphere(command, radius)
        status = self._submit(
            command, _capi.CMD_CREATE_COLLISION_SHAPE_COMPLETED, "create a shape"
        )
        return _capi.status_shape(status)

    def _create_visual_shape(self, shape: Shape, look: Look, *, is_marker: bool) -> int:
        """A shape to be seen; -1, as here, is none."""
        return -1
