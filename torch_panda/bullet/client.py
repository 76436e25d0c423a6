"""One DIRECT client of Bullet: a world of bodies that is built, moved and observed."""

from collections.abc import Sequence
from ctypes import byref, c_int
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from typing_extensions import Self

from torch_panda.bullet import building, capi, library, structs
from torch_panda.bullet.blueprint import (
    Blueprint,
    Command,
    CreateBody,
    LoadURDF,
    Quaternion,
    SetBase,
    SetCollisionFilter,
    SetJoints,
    SetPhysics,
)
from torch_panda.bullet.body_state import Q_OFFSET, U_OFFSET, BodyState, Doubles
from torch_panda.bullet.building import ORIGIN
from torch_panda.bullet.connection import (
    BulletError,
    connect,
    doubles,
    shared_doubles,
)
from torch_panda.bullet.physics import EXACT, PhysicsParams
from torch_panda.bullet.shapes import Box, Cylinder, Shape, Sphere, Visual
from torch_panda.bullet.urdf import Tool, check_urdf, find_urdf, urdf_with_tool
from torch_panda.checks import (
    check_above_zero,
    check_not_negative,
    check_quaternion,
    check_vector,
)
from torch_panda.rotations import NO_ROTATION

if TYPE_CHECKING:  # imported at its first use
    from torch_panda.bullet.contacts import ContactPoint

# pybullet's default velocityGain in setJointMotorControlArray.
VELOCITY_GAIN = 1.0


class Joint(NamedTuple):
    """A joint of a body, as its URDF describes it, but with its present damping.

    Attributes:
        number: Index of the joint, and of the link that it moves.
        name: Name of the joint.
        num_dofs: Number of its degrees of freedom; 0 if the joint is fixed.
        damping: Damping [N m s/rad] or [N s/m].
        lower_limit: Lowest position [rad] or [m].
        upper_limit: Highest position. It is below ``lower_limit`` if the joint has no
            limits.
    """

    number: int
    name: str
    num_dofs: int
    damping: float
    lower_limit: float
    upper_limit: float

    @property
    def is_movable(self) -> bool:
        """Whether the joint has one degree of freedom."""
        return self.num_dofs == 1


class PhysicsClient:
    """One DIRECT client of Bullet: a world of bodies.

    One thread at a time may use a client.

    The client has no visual shapes. Instead, its `blueprint` holds the commands that
    built the scene. A renderer builds its own copy of the scene from the blueprint and
    draws that copy.

    Args:
        physics: Parameters of the integration.

    Raises:
        ImportError: The C API of the installed pybullet is not the supported one.
        BulletError: Bullet could not create a client.
        ValueError: The environment variable ``TORCH_PANDA_SOLVER`` is wrong.
        RuntimeError: It asks for the faster solver, which cannot run here.

    Attributes:
        connection: The connection to Bullet, for commands that this class lacks.
        struct: The struct through which C code uses the client; see `Loop`.
        gravity: Gravity along the world's z axis [m/s^2]; see `set_gravity`.
    """

    def __init__(self, *, physics: PhysicsParams = EXACT) -> None:
        # Imported here, because only clients need this package.
        from torch_panda.bullet import solver

        solver.activate()
        self.connection = connect()
        self.struct = structs.Client(handle=self.connection.handle)
        self._physics = physics
        self.gravity = physics.gravity
        self._num_joints: dict[int, int] = {}  # by body, in the order of building
        # Damping that was set, by body and joint: Bullet does not report it.
        self._joint_damping: dict[tuple[int, int], float] = {}
        self._blueprint: list[Command] = []
        self._is_recording = True
        try:
            self._check_status_codes()
            self._set_physics(physics)
        except BaseException:
            self.close()
            raise

    def _check_status_codes(self) -> None:
        """Check that Bullet's status codes are those of `capi`.

        New versions of Bullet insert codes in the middle of the list, which shifts all
        higher codes. One collision detection is enough as a check, because it has the
        highest code that torch_panda uses.

        Raises:
            ImportError: The codes differ.
        """
        command = capi.detect_init(self.connection.handle)
        expected = capi.CMD_PERFORM_COLLISION_DETECTION_COMPLETED
        self.struct.num_detections += 1
        try:
            self.connection.submit(command, expected, "detect collisions")
        except BulletError as error:
            raise library.wrong_pybullet(f"its status codes differ: {error}") from None

    def _set_physics(self, physics: PhysicsParams) -> None:
        command = capi.physics_init(self.connection.handle)
        capi.physics_set_timestep(command, physics.timestep)
        capi.physics_set_gravity(command, 0.0, 0.0, physics.gravity)
        capi.physics_set_solver_iterations(command, physics.solver_iterations)
        capi.physics_set_residual_threshold(command, physics.residual_threshold)
        self._run(command, "set parameters")

    def close(self) -> None:
        """Free the world. Closing again does nothing."""
        self.struct.handle = None
        self.connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __reduce__(self) -> "tuple[object, ...]":
        raise TypeError("a PhysicsClient owns native memory and cannot be pickled")

    # ---- building a scene --------------------------------------------------------

    @property
    def bodies(self) -> tuple[int, ...]:
        """Ids of the bodies, in the order in which they were built."""
        return tuple(self._num_joints)

    @property
    def blueprint(self) -> Blueprint:
        """The commands that built the scene; equal in clients of the same scene."""
        return tuple(self._blueprint)

    def finish_building(self) -> None:
        """Stop recording commands in the blueprint."""
        self._is_recording = False

    def load_urdf(
        self,
        path: str | Path,
        *,
        position: Sequence[float] = ORIGIN,
        orientation: Sequence[float] = NO_ROTATION,
        fixed_base: bool = False,
        tool: Tool | None = None,
    ) -> int:
        """Load a URDF and return its body id.

        Args:
            path: Path of the file, or its path among the files that pybullet ships.
            position: Position of the base, world frame [m].
            orientation: Orientation of the base, quaternion xyzw.
            fixed_base: Whether the base cannot move.
            tool: A massless link to add to the URDF; None adds none.

        Raises:
            FileNotFoundError: The file does not exist.
            ValueError: The URDF is broken, lacks a mesh, or sets collision groups; see
                `urdf.check_urdf`. Set groups with `set_collision_filter` instead.
            BulletError: Bullet cannot load the file. Bullet prints the reason.
        """
        check_quaternion("orientation", orientation)
        file = find_urdf(path)
        check_urdf(file)
        if tool is not None:
            file = urdf_with_tool(file, tool)
        base_position = check_vector("position", position)
        rotation = _quaternion(orientation)
        body = building.load_urdf(
            self.connection,
            file,
            base_position,
            rotation,
            fixed_base=fixed_base,
            flags=capi.URDF_IGNORE_VISUAL_SHAPES,
        )
        self._num_joints[body] = capi.joint_count(self.connection.handle, body)
        self._record(LoadURDF(body, file, base_position, rotation, fixed_base))
        return body

    def create_box(
        self,
        half_extents: Sequence[float],
        *,
        mass: float,
        position: Sequence[float],
        visual: Visual = Visual(),  # noqa: B008 (frozen)
    ) -> int:
        """Create a box and return its body id.

        Args:
            half_extents: Half the edge lengths along x, y and z [m].
            mass: Mass [kg]; 0 makes a body that never moves.
            position: Position of its centre, world frame [m].
            visual: How renderers draw the box.

        Raises:
            ValueError: A size is not above 0, the mass is negative, or a number is not
                finite.
            TypeError: A size or the mass is not a number.
        """
        shape = Box(check_vector("half_extents", half_extents))
        return self._create_body(shape, mass, position, visual)

    def create_cylinder(
        self,
        radius: float,
        height: float,
        *,
        mass: float,
        position: Sequence[float],
        visual: Visual = Visual(),  # noqa: B008 (frozen)
    ) -> int:
        """Create an upright cylinder and return its body id; see `create_box`."""
        return self._create_body(Cylinder(radius, height), mass, position, visual)

    def create_sphere(
        self,
        radius: float,
        *,
        mass: float,
        position: Sequence[float],
        visual: Visual = Visual(),  # noqa: B008 (frozen)
    ) -> int:
        """Create a sphere and return its body id; see `create_box`."""
        return self._create_body(Sphere(radius), mass, position, visual)

    def create_marker(
        self,
        position: Sequence[float],
        shape: Shape | None = None,
        *,
        visual: Visual = Visual(),  # noqa: B008 (frozen)
    ) -> int:
        """Create a marker, a body that touches nothing, and return its id.

        Args:
            position: Position of its centre, world frame [m].
            shape: Shape that renderers draw; None makes the marker invisible.
            visual: How renderers draw the shape. Markers are translucent.

        Raises:
            ValueError: A size is not above 0, or a number is not finite.
            TypeError: A size is not a number.
        """
        return self._create_body(shape, 0.0, position, visual, is_marker=True)

    def _create_body(
        self,
        shape: Shape | None,
        mass: float,
        position: Sequence[float],
        visual: Visual,
        *,
        is_marker: bool = False,
    ) -> int:
        check_not_negative(mass=mass)
        centre = check_vector("position", position)
        if shape is not None:
            _check_shape(shape)
        collision_shape = building.NO_SHAPE
        if shape is not None and not is_marker:
            collision_shape = self._create_collision_shape(shape)
        body = building.create_body(
            self.connection, centre, mass=mass, collision_shape=collision_shape
        )
        self._num_joints[body] = 0
        self._record(CreateBody(body, shape, mass, centre, visual, is_marker))
        return body

    def _create_collision_shape(self, shape: Shape) -> int:
        command = capi.shape_init(self.connection.handle)
        match shape:
            case Box(half_extents):
                capi.shape_add_box(command, doubles(half_extents))
            case Cylinder(radius, height):
                capi.shape_add_cylinder(command, radius, height)
            case Sphere(radius):
                capi.shape_add_sphere(command, radius)
        status = self.connection.submit(
            command, capi.CMD_CREATE_COLLISION_SHAPE_COMPLETED, "create a shape"
        )
        return int(capi.status_shape(status))

    def _record(self, command: Command) -> None:
        if self._is_recording:
            self._blueprint.append(command)

    # ---- links and joints --------------------------------------------------------

    def joints(self, body: int) -> list[Joint]:
        """The joints of a body in Bullet's order: depth-first from the base."""
        self._check_link(body)
        handle = self.connection.handle
        info = capi.JointInfo()
        joints = []
        for index in range(self._num_joints[body]):
            capi.joint_info(handle, body, index, byref(info))
            joint = Joint(
                number=index,
                name=info.joint_name.decode(),
                num_dofs=info.u_size,
                damping=self._joint_damping.get((body, index), info.damping),
                lower_limit=info.lower_limit,
                upper_limit=info.upper_limit,
            )
            joints.append(joint)
        return joints

    def _check_link(self, body: int, link: int = -1, *, lowest: int = -1) -> None:
        """Check that a link (-1 is the base) exists, because Bullet ignores others.

        Args:
            body: Body id.
            link: Index of the link, or of the joint that moves it.
            lowest: Lowest valid index; 0 for joints.

        Raises:
            ValueError: The body or the link does not exist.
        """
        count = self._num_joints.get(body)
        if count is None:
            raise ValueError(f"a body id must be one of {self.bodies}, got {body}")
        if not lowest <= link < count:
            parts = "links besides its base (-1)" if lowest else "joints"
            raise ValueError(
                f"body {body} has {count} {parts}, numbered from 0, got {link}"
            )

    def mass(self, body: int, link: int = -1) -> float:
        """Mass of a link (-1 is the base) [kg]; 0 for a base that cannot move."""
        return float(self._dynamics(body, link).mass)

    def friction(self, body: int, link: int = -1) -> float:
        """Lateral friction of a link (-1 is the base)."""
        return float(self._dynamics(body, link).lateral_friction)

    def restitution(self, body: int, link: int = -1) -> float:
        """Restitution of a link (-1 is the base)."""
        return float(self._dynamics(body, link).restitution)

    def inertial_frame(self, body: int, link: int = -1) -> tuple[float, ...]:
        """Pose (7,) of a link's inertial frame in the link's URDF frame.

        Args:
            body: Body id.
            link: Index of the link; -1 is the base.

        Returns:
            Centre of mass [m] and quaternion xyzw.
        """
        return tuple(self._dynamics(body, link).local_inertial_frame)

    def _dynamics(self, body: int, link: int) -> capi.DynamicsInfo:
        self._check_link(body, link)
        command = capi.dynamics_info_init(self.connection.handle, body, link)
        status = self.connection.submit(
            command, capi.CMD_GET_DYNAMICS_INFO_COMPLETED, "report dynamics"
        )
        info = capi.DynamicsInfo()
        capi.dynamics_info(status, byref(info))
        return info

    def set_friction(
        self,
        body: int,
        link: int = -1,
        *,
        lateral: float | None = None,
        spinning: float | None = None,
        rolling: float | None = None,
    ) -> None:
        """Set the friction coefficients of a link (-1 is the base).

        A coefficient that is None stays as it is.

        Raises:
            ValueError: A coefficient is negative or not finite, or the link does not
                exist.
        """
        self.set_dynamics(
            body,
            link,
            lateral_friction=lateral,
            spinning_friction=spinning,
            rolling_friction=rolling,
        )

    def set_dynamics(
        self,
        body: int,
        link: int = -1,
        *,
        mass: float | None = None,
        lateral_friction: float | None = None,
        spinning_friction: float | None = None,
        rolling_friction: float | None = None,
        restitution: float | None = None,
        joint_damping: float | None = None,
    ) -> None:
        """Change physical properties of a link (-1 is the base).

        None keeps a property as it is. For a contact between two links, Bullet
        multiplies their lateral frictions, and also multiplies their restitutions. The
        spinning and the rolling friction of each link are multiplied by the lateral
        friction of the other link, and the two products are added.

        Args:
            body: Body id.
            link: Index of the link.
            mass: Mass [kg]. Bullet computes a new inertia from the mass and the
                collision shape.
            lateral_friction: Coefficient of friction along the surface.
            spinning_friction: Coefficient of friction against rotation about the normal
                of a contact.
            rolling_friction: Coefficient of friction against rolling. Without it, a
                ball never comes to rest.
            restitution: Share of its speed that a body keeps when it bounces, 0 to 1.
            joint_damping: Damping of the joint that moves the link [N m s/rad] or
                [N s/m].

        Raises:
            ValueError: A number is negative or not finite, or the link does not exist.
        """
        self._check_link(body, link)
        numbers = {
            "mass": mass,
            "lateral_friction": lateral_friction,
            "spinning_friction": spinning_friction,
            "rolling_friction": rolling_friction,
            "restitution": restitution,
            "joint_damping": joint_damping,
        }
        changes = {name: x for name, x in numbers.items() if x is not None}
        check_not_negative(**changes)
        command = capi.dynamics_init(self.connection.handle)
        for name, value in changes.items():
            _DYNAMICS_SETTERS[name](command, body, link, value)
        self.connection.submit(
            command, capi.CMD_CLIENT_COMMAND_COMPLETED, "set dynamics"
        )
        if joint_damping is not None:
            self._joint_damping[body, link] = joint_damping
        self._record(SetPhysics("set_dynamics", (body, link, *numbers.values())))

    def set_joint_friction(self, body: int, joint: int, force: float) -> None:
        """Set the friction [N m] or [N] of a joint that nothing else controls.

        Every joint has a motor that brakes it. This call sets the largest force of this
        motor. Bullet's default is an impulse of 1 N m s or 1 N s per substep, which is
        500 N m or 500 N at the default substep of 2 ms.

        Raises:
            ValueError: The force is negative or not finite, or the joint does not
                exist.
        """
        self._check_link(body, joint, lowest=0)
        check_not_negative(force=force)
        handle, info = self.connection.handle, capi.JointInfo()
        capi.joint_info(handle, body, joint, byref(info))
        command = capi.motor_init(handle, body, capi.CONTROL_MODE_POSITION_VELOCITY_PD)
        capi.motor_set_velocity(command, info.u_index, 0.0)
        capi.motor_set_kp(command, info.u_index, 0.0)
        capi.motor_set_kd(command, info.u_index, VELOCITY_GAIN)
        capi.motor_set_force(command, info.u_index, force)
        self.connection.submit(
            command, capi.CMD_DESIRED_STATE_RECEIVED_COMPLETED, "set a motor"
        )
        self._record(SetPhysics("set_joint_friction", (body, joint, force)))

    def set_collision_filter(self, body: int, link: int, group: int, mask: int) -> None:
        """Set the collision group and mask of a link (-1 is the base), two bit fields.

        Two links A and B can touch if ``group_A & mask_B`` or ``group_B & mask_A`` is
        not 0. (One of them suffices in pybullet; Bullet's own default needs both.)
        `VectorSimulation.reset` restores the filters that were set during building.

        Bullet removes the link from the broad phase and inserts it again, so the link
        loses its present overlaps and contacts.

        Raises:
            ValueError: The link does not exist.
        """
        self._check_link(body, link)
        command = capi.filter_init(self.connection.handle)
        capi.filter_set_group_mask(command, body, link, group, mask)
        self._run(command, "set a collision filter")
        self._record(SetCollisionFilter(body, link, group, mask))

    def enable_wrench_sensor(self, body: int, joint: int) -> None:
        """Make Bullet compute the wrench in a joint; see `BodyState.wrenches`.

        Raises:
            ValueError: The joint does not exist.
        """
        self._check_link(body, joint, lowest=0)
        handle = self.connection.handle
        command = capi.physics_init(handle)
        capi.physics_set_joint_feedback(command, capi.JOINT_FEEDBACK_IN_JOINT_FRAME)
        self._run(command, "set parameters")
        command = capi.sensor_init(handle, body)
        capi.sensor_enable_wrench(command, joint, 1)
        self._run(command, "add a sensor")
        self._record(SetPhysics("enable_wrench_sensor", (body, joint)))

    # ---- moving the world --------------------------------------------------------

    def set_joint(
        self, body: int, joint: int, position: float, velocity: float
    ) -> None:
        """Set the position [rad] or [m] and velocity [rad/s] or [m/s] of a joint."""
        self.set_joints(body, (joint,), (position,), (velocity,))

    def set_joints(
        self,
        body: int,
        joints: Sequence[int],
        positions: Sequence[float],
        velocities: Sequence[float],
    ) -> None:
        """Set the positions and velocities of several joints; see `set_joint`.

        Raises:
            ValueError: A joint does not exist.
        """
        for joint in joints:
            self._check_link(body, joint, lowest=0)
        building.set_joints(self.connection, body, joints, positions, velocities)
        if self._is_recording:
            self._record(
                SetJoints(body, tuple(joints), tuple(float(x) for x in positions))
            )

    def set_base(
        self,
        body: int,
        position: Sequence[float],
        orientation: Sequence[float] = NO_ROTATION,
        linear_velocity: Sequence[float] = ORIGIN,
        angular_velocity: Sequence[float] = ORIGIN,
    ) -> None:
        """Set the pose and the velocity of a body's base, in the world frame.

        Args:
            body: Body id.
            position: Position of the base's centre of mass [m].
            orientation: Quaternion xyzw.
            linear_velocity: Linear velocity [m/s].
            angular_velocity: Angular velocity [rad/s].

        Raises:
            ValueError: The position is not finite, the quaternion has no direction, or
                the body does not exist.
        """
        centre = check_vector("position", position)
        check_quaternion("orientation", orientation)
        self._check_link(body)
        building.set_base(
            self.connection,
            body,
            centre,
            orientation,
            linear_velocity,
            angular_velocity,
        )
        self._record(SetBase(body, centre, _quaternion(orientation)))

    def set_gravity(self, gravity: float) -> None:
        """Set gravity along the world's z axis [m/s^2]."""
        command = capi.physics_init(self.connection.handle)
        capi.physics_set_gravity(command, 0.0, 0.0, gravity)
        self._run(command, "set gravity")
        self.gravity = gravity
        self._record(SetPhysics("set_gravity", (gravity,)))

    def save(self) -> int:
        """Take a snapshot of all poses and velocities, and return its id.

        The C code of resets loads it; see ``broad_phase.py``.
        """
        command = capi.save_init(self.connection.handle)
        status = self.connection.submit(
            command, capi.CMD_SAVE_STATE_COMPLETED, "save a state"
        )
        return int(capi.status_snapshot(status))

    def control_joints(
        self,
        body: int,
        positions: Doubles,
        forces: Sequence[float],
        velocities: Sequence[float] | Doubles = (),
    ) -> None:
        """Set the targets of the motors of all movable joints of a body.

        The first ``len(velocities)`` joints get velocity targets. The remaining joints
        get position targets. This works like pybullet's ``setJointMotorControlArray``,
        but with the position gain `PhysicsParams.position_gain`.

        Args:
            body: Body id.
            positions: Target positions of the remaining joints [rad] or [m].
            forces: Maximum force of each joint's motor [N m] or [N].
            velocities: Target velocities of the first joints [rad/s] or [m/s].
        """
        command = capi.motor_init(
            self.connection.handle, body, capi.CONTROL_MODE_POSITION_VELOCITY_PD
        )
        for k, velocity in enumerate(velocities):
            capi.motor_set_velocity(command, U_OFFSET + k, velocity)
            capi.motor_set_kp(command, U_OFFSET + k, 0.0)
        for k, position in enumerate(positions, start=len(velocities)):
            capi.motor_set_position(command, Q_OFFSET + k, position)
            capi.motor_set_kp(command, U_OFFSET + k, self._physics.position_gain)
        for k, force in enumerate(forces):
            capi.motor_set_kd(command, U_OFFSET + k, VELOCITY_GAIN)
            capi.motor_set_force(command, U_OFFSET + k, force)
        self.connection.submit(
            command, capi.CMD_DESIRED_STATE_RECEIVED_COMPLETED, "control joints"
        )

    def step(self, count: int = 1) -> None:
        """Advance the world by ``count`` substeps."""
        # One command serves all substeps: it lies in the client's command buffer, and a
        # substep does not overwrite this buffer.
        command = capi.step_init(self.connection.handle)
        for _ in range(count):
            self.struct.num_detections += 1
            self.connection.submit(
                command, capi.CMD_STEP_FORWARD_SIMULATION_COMPLETED, "step"
            )

    # ---- observing the world -----------------------------------------------------

    @property
    def num_detections(self) -> int:
        """Number of collision detections so far; every substep has one."""
        return self.struct.num_detections

    def state(self, body: int) -> BodyState:
        """The state of a body: base, joints, links, and forces in the joints.

        Raises:
            ValueError: The body does not exist.
        """
        self._check_link(body)
        command = capi.state_init(self.connection.handle, body)
        return BodyState(
            self.connection.submit(
                command, capi.CMD_ACTUAL_STATE_UPDATE_COMPLETED, "report a state"
            )
        )

    def contact_points(
        self, body_a: int | None = None, body_b: int | None = None
    ) -> list["ContactPoint"]:
        """Contacts of the last substep.

        Args:
            body_a: Only contacts of this body. Where Bullet reports it as the second
                body, the two bodies of the contact are swapped. None means all
                contacts, unswapped.
            body_b: Only contacts whose second body (after swapping) is this body. None
                means any second body.
        """
        from torch_panda.bullet.contacts import read_contact

        # Filter in Python: Bullet's own filter exchanges bodies a and b where needed,
        # but does not reverse the friction forces.
        handle = self.connection.handle
        self.connection.submit(
            capi.contact_init(handle),
            capi.CMD_CONTACT_POINT_INFORMATION_COMPLETED,
            "report contacts",
        )
        information = capi.ContactInformation()
        capi.contact_result(handle, byref(information))
        contacts = []
        for point in information.points[: information.count]:
            contact = read_contact(point)
            if body_a not in (None, contact.body_a):
                contact = contact.swapped()
            if body_a in (None, contact.body_a) and body_b in (None, contact.body_b):
                contacts.append(contact)
        return contacts

    def inverse_kinematics(
        self,
        body: int,
        link: int,
        position: Doubles,
        orientation: Sequence[float],
        joint_positions: Doubles,
    ) -> None:
        """Find joint positions that bring a link to a pose.

        The solver is Bullet's default, damped least squares. Bullet's other solvers
        keep a vector in static memory, so they are not thread-safe.

        Args:
            body: Body id.
            link: Index of the link.
            position: Target of the origin of the link's URDF frame (3,), which may lie
                beside its centre of mass; see `inertial_frame`. World frame [m].
            orientation: Target orientation of its inertial frame, quaternion xyzw.
            joint_positions: Output, one position per movable joint.
        """
        command = capi.ik_init(self.connection.handle, body)
        capi.ik_set_target(
            command, link, shared_doubles(position), doubles(orientation)
        )
        damping = [self._physics.ik_damping] * len(joint_positions)
        capi.ik_set_iterations(command, self._physics.ik_iterations)
        capi.ik_set_damping(command, len(damping), doubles(damping))
        status = self.connection.submit(
            command,
            capi.CMD_CALCULATE_INVERSE_KINEMATICS_COMPLETED,
            "solve the inverse kinematics",
        )
        capi.ik_result(
            status, byref(c_int()), byref(c_int()), shared_doubles(joint_positions)
        )

    def _run(self, command: int, action: str) -> None:
        """Submit a command that has no result, and check that it succeeded."""
        self.connection.submit(command, capi.CMD_CLIENT_COMMAND_COMPLETED, action)


_DYNAMICS_SETTERS = {
    "mass": capi.dynamics_set_mass,
    "lateral_friction": capi.dynamics_set_lateral_friction,
    "spinning_friction": capi.dynamics_set_spinning_friction,
    "rolling_friction": capi.dynamics_set_rolling_friction,
    "restitution": capi.dynamics_set_restitution,
    "joint_damping": capi.dynamics_set_joint_damping,
}


def _check_shape(shape: Shape) -> None:
    """Check that a shape has finite sizes above 0."""
    for name, size in shape._asdict().items():
        sizes = check_vector(name, size) if name == "half_extents" else (size,)
        for number in sizes:
            check_above_zero(**{name: number})


def _quaternion(values: Sequence[float]) -> Quaternion:
    x, y, z, w = map(float, values)
    return x, y, z, w
