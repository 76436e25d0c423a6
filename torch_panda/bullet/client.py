"""One DIRECT physics client of Bullet."""

from collections.abc import Sequence
from ctypes import byref, c_int

from torch_panda.bullet import capi, library, native
from torch_panda.bullet.body_state import Q_OFFSET, U_OFFSET, BodyState, Doubles
from torch_panda.bullet.connection import BulletError, doubles, shared
from torch_panda.bullet.contacts import ContactPoint, read_contact
from torch_panda.bullet.physics import EXACT, PhysicsParams
from torch_panda.bullet.scene_client import NO_ROTATION, ORIGIN, SceneClient

# pybullet's default for setJointMotorControlArray(POSITION_CONTROL).
VELOCITY_GAIN = 1.0


class PhysicsClient(SceneClient):
    """One DIRECT client: a world of bodies that moves.

    Args:
        physics: how it integrates.

    Raises:
        ImportError: the installed pybullet has another C API.

    Attributes:
        native: what the native loop knows of it.
    """

    def __init__(self, *, physics: PhysicsParams = EXACT) -> None:
        super().__init__()
        self.native = native.Client(self._handle, 0)
        # The last status code in use: it moves when another version adds one before.
        try:
            self.detect_collisions()
        except BulletError as error:
            self.close()
            raise library.wrong_pybullet(f"its status codes differ: {error}") from None
        command = capi.physics_init(self._handle)
        capi.physics_set_timestep(command, physics.timestep)
        capi.physics_set_gravity(command, 0.0, 0.0, physics.gravity)
        capi.physics_set_solver_iterations(command, physics.solver_iterations)
        capi.physics_set_residual_threshold(command, physics.residual_threshold)
        self._submit(command, capi.CMD_CLIENT_COMMAND_COMPLETED, "set parameters")
        self._physics = physics

    @property
    def num_detections(self) -> int:
        """How often collisions have been detected; every time step does."""
        return self.native.num_detections

    def close(self) -> None:
        """Free the world. Closing again does nothing."""
        self.native.handle = None
        super().close()

    # ---- moving the world --------------------------------------------------------

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
        command = capi.pose_init(self._open(), body)
        for joint, position, velocity in zip(
            joints, positions, velocities, strict=True
        ):
            capi.pose_set_joint_position(self._handle, command, joint, position)
            capi.pose_set_joint_velocity(self._handle, command, joint, velocity)
        self._submit(command, capi.CMD_CLIENT_COMMAND_COMPLETED, "set joints")

    def set_base(
        self,
        body: int,
        position: Sequence[float],
        orientation: Sequence[float] = NO_ROTATION,
        linear_velocity: Sequence[float] = ORIGIN,
        angular_velocity: Sequence[float] = ORIGIN,
    ) -> None:
        """Put a body somewhere, with a velocity, in the world frame.

        Args:
            body: the body.
            position: of its centre of mass [m].
            orientation: quaternion xyzw.
            linear_velocity: [m/s].
            angular_velocity: [rad/s].
        """
        command = capi.pose_init(self._open(), body)
        capi.pose_set_linear_velocity(command, doubles(linear_velocity))
        capi.pose_set_angular_velocity(command, doubles(angular_velocity))
        capi.pose_set_position(command, *position)
        capi.pose_set_orientation(command, *orientation)
        self._submit(command, capi.CMD_CLIENT_COMMAND_COMPLETED, "set a base pose")

    def set_gravity(self, gravity: float) -> None:
        """Set gravity along the world's z axis [m/s^2]."""
        command = capi.physics_init(self._open())
        capi.physics_set_gravity(command, 0.0, 0.0, gravity)
        self._submit(command, capi.CMD_CLIENT_COMMAND_COMPLETED, "set gravity")

    def save(self) -> int:
        """Take a snapshot of all poses, velocities and contacts; return its id."""
        command = capi.save_init(self._open())
        status = self._submit(command, capi.CMD_SAVE_STATE_COMPLETED, "save a state")
        return int(capi.status_snapshot(status))

    def load(self, snapshot: int) -> None:
        """Put everything where it was in a snapshot that was taken without contacts.

        Other than `set_base` it leaves the links' boxes, from which Bullet's broad
        phase finds overlaps, where they are until the next collision detection.
        """
        command = capi.load_init(self._open())
        capi.load_set_snapshot(command, snapshot)
        self._submit(command, capi.CMD_RESTORE_STATE_COMPLETED, "load a state")

    def control_joints(
        self,
        body: int,
        positions: Doubles,
        forces: Sequence[float],
        velocities: Sequence[float] | Doubles = (),
    ) -> None:
        """Drive the first movable joints to velocities, the others to positions.

        Does what pybullet's ``setJointMotorControlArray`` does in velocity and in
        position control, with the position gain of the client's physics. For positions
        the desired velocity is Bullet's default, 0.

        Args:
            body: the body.
            positions: of the others [rad] or [m].
            forces: the most each motor may exert [N m] or [N].
            velocities: of the first ones [rad/s] or [m/s].
        """
        command = capi.motor_init(
            self._open(), body, capi.CONTROL_MODE_POSITION_VELOCITY_PD
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
        # Bullet only takes notes: done before another thread could use the GIL.
        status = capi.submit_quick(self._open(), command)
        self._check(status, capi.CMD_DESIRED_STATE_RECEIVED_COMPLETED, "control joints")

    def apply_torques(self, body: int, torques: Doubles) -> None:
        """Turn the first movable joints by torques [N m] for one time step."""
        command = capi.motor_init(self._open(), body, capi.CONTROL_MODE_TORQUE)
        for k, torque in enumerate(torques):
            capi.motor_set_torque(command, U_OFFSET + k, torque)
        status = capi.submit_quick(self._open(), command)
        self._check(status, capi.CMD_DESIRED_STATE_RECEIVED_COMPLETED, "apply torques")

    def step(self, count: int = 1) -> None:
        """Advance the world by ``count`` time steps."""
        handle = self._open()
        # A client has one command buffer, and stepping leaves it as it was: submitting
        # it again steps again.
        command = capi.step_init(handle)
        expected = capi.CMD_STEP_FORWARD_SIMULATION_COMPLETED
        for _ in range(count):
            self.native.num_detections += 1
            self._check(capi.submit(handle, command), expected, "step")

    def detect_collisions(self, count: int = 1) -> None:
        """Run collision detection ``count`` times without advancing time."""
        if count < 1:
            return
        handle = self._open()
        command = capi.detect_init(handle)
        self.native.num_detections += count
        for _ in range(count):  # as in `step`; the last answer is checked
            status = capi.submit(handle, command)
        self._check(
            status,
            capi.CMD_PERFORM_COLLISION_DETECTION_COMPLETED,
            "detect collisions",
        )

    # ---- asking it ---------------------------------------------------------------

    def inverse_kinematics(
        self,
        body: int,
        link: int,
        position: Doubles,
        orientation: Sequence[float],
        joint_positions: Doubles,
    ) -> None:
        """Find joint positions that bring a link to a pose, by damped least squares.

        The default solver, because the others share a static work vector.

        Args:
            body: the body.
            link: whose centre of mass is to be moved.
            position: (3,), where to, world frame [m].
            orientation: quaternion xyzw.
            joint_positions: receives one position per movable joint.
        """
        command = capi.ik_init(self._open(), body)
        capi.ik_set_target(command, link, shared(position), doubles(orientation))
        damping = [self._physics.ik_damping] * len(joint_positions)
        capi.ik_set_iterations(command, self._physics.ik_iterations)
        capi.ik_set_damping(command, len(damping), doubles(damping))
        status = self._submit(
            command,
            capi.CMD_CALCULATE_INVERSE_KINEMATICS_COMPLETED,
            "solve the inverse kinematics",
        )
        capi.ik_result(status, byref(c_int()), byref(c_int()), shared(joint_positions))

    def state(self, body: int, *, link_velocities: bool = False) -> BodyState:
        """The state of a body: its base, joints and links, and the forces in it."""
        command = capi.state_init(self._open(), body)
        if link_velocities:
            capi.state_want_link_velocity(command, 1)
        return BodyState(
            self._submit(
                command, capi.CMD_ACTUAL_STATE_UPDATE_COMPLETED, "report a state"
            )
        )

    def contact_points(
        self, body_a: int | None = None, body_b: int | None = None
    ) -> list[ContactPoint]:
        """Contacts of the last step, of all bodies or of those given."""
        # Not filtered by Bullet, which would swap a and b but not the friction.
        command = capi.contact_init(self._open())
        self._submit(
            command, capi.CMD_CONTACT_POINT_INFORMATION_COMPLETED, "report contacts"
        )
        found = capi.ContactInformation()
        capi.contact_result(self._handle, byref(found))
        points = []
        for point in found.points[: found.count]:
            contact = read_contact(point)
            if body_a not in (None, contact.body_a):
                contact = contact.swapped()
            if body_a in (None, contact.body_a) and body_b in (None, contact.body_b):
                points.append(contact)
        return points
