"""What the links of bodies are, and how they move and touch: asking and changing it."""

from ctypes import byref
from dataclasses import dataclass

from torch_panda.bullet import capi
from torch_panda.bullet.connection import Connection
from torch_panda.checks import check_not_negative

# What was built, one command after the other: its name and its arguments.
Blueprint = tuple[tuple[object, ...], ...]


@dataclass(frozen=True)
class Joint:
    """A joint of a body, as its URDF describes it."""

    index: int
    name: str
    link_name: str
    is_movable: bool
    damping: float


# The arguments of `LinkClient.set_dynamics`, and what sets them.
_DYNAMICS = (
    ("mass", capi.dynamics_set_mass),
    ("lateral_friction", capi.dynamics_set_lateral_friction),
    ("spinning_friction", capi.dynamics_set_spinning_friction),
    ("restitution", capi.dynamics_set_restitution),
    ("joint_damping", capi.dynamics_set_joint_damping),
)


class LinkClient(Connection):
    """A client whose bodies' links can be asked about and changed."""

    def __init__(self) -> None:
        self._blueprint: list[tuple[object, ...]] = []
        self._is_built = False
        super().__init__()

    @property
    def blueprint(self) -> Blueprint:
        """What was built and how; equal in clients that hold the same scene."""
        return tuple(self._blueprint)

    def finish_building(self) -> None:
        """What is changed from now on is no part of the blueprint."""
        self._is_built = True

    def _note(self, *command: object) -> None:
        if not self._is_built:
            self._blueprint.append(command)

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
        self.set_dynamics(
            body, link, lateral_friction=lateral, spinning_friction=spinning
        )

    def set_dynamics(
        self,
        body: int,
        link: int = -1,
        *,
        mass: float | None = None,
        lateral_friction: float | None = None,
        spinning_friction: float | None = None,
        restitution: float | None = None,
        joint_damping: float | None = None,
    ) -> None:
        """Change how a link (-1 is the base) moves; None leaves a number as it is.

        Args:
            body: the body.
            link: the link.
            mass: [kg]; the inertia of a body's base follows it.
            lateral_friction: Bullet multiplies those of two bodies that touch.
            spinning_friction: about the normal of a contact.
            restitution: 1 bounces back as fast; multiplied, too.
            joint_damping: of the link's joint [N m s/rad] or [N s/m].

        Raises:
            ValueError: a number is negative or not finite.
        """
        numbers = (
            mass,
            lateral_friction,
            spinning_friction,
            restitution,
            joint_damping,
        )
        self._note("set_dynamics", body, link, *numbers)
        command = capi.dynamics_init(self._open())
        for (name, change), value in zip(_DYNAMICS, numbers, strict=True):
            if value is not None:
                check_not_negative(**{name: value})
                change(command, body, link, value)
        # Bullet only takes notes: done before another thread could use the GIL.
        status = capi.submit_quick(self._open(), command)
        self._check(status, capi.CMD_CLIENT_COMMAND_COMPLETED, "set dynamics")

    def set_joint_friction(self, body: int, joint: int, force: float) -> None:
        """Let a joint that nothing drives resist motion, by up to a force [N or N m].

        Bullet gives a joint about 1 N of it unless told otherwise.

        Raises:
            ValueError: the force is negative or not finite.
        """
        check_not_negative(force=force)
        self._note("set_joint_friction", body, joint, force)
        info = capi.JointInfo()
        capi.joint_info(self._open(), body, joint, byref(info))
        command = capi.motor_init(
            self._open(), body, capi.CONTROL_MODE_POSITION_VELOCITY_PD
        )
        capi.motor_set_velocity(command, info.u_index, 0.0)
        capi.motor_set_kp(command, info.u_index, 0.0)
        capi.motor_set_kd(command, info.u_index, 1.0)
        capi.motor_set_force(command, info.u_index, force)
        self._submit(command, capi.CMD_DESIRED_STATE_RECEIVED_COMPLETED, "set a motor")

    def set_collision_filter(self, body: int, link: int, group: int, mask: int) -> None:
        """Choose what a link (-1 is the base) touches, and forget what it touched.

        Two links touch if the group of either has a bit of the other's mask. The link
        enters Bullet's broad phase anew: without its overlaps and contacts so far, and
        as the last of all links.
        """
        command = capi.filter_init(self._open())
        capi.filter_set_group_mask(command, body, link, group, mask)
        self._submit(
            command, capi.CMD_CLIENT_COMMAND_COMPLETED, "set a collision filter"
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

    def centre_of_mass(self, body: int, link: int = -1) -> tuple[float, ...]:
        """Centre of mass of a link (-1 is the base) in the frame of its URDF [m]."""
        return tuple(self._dynamics(body, link).local_inertial_frame[:3])

    def _dynamics(self, body: int, link: int) -> capi.DynamicsInfo:
        command = capi.dynamics_info_init(self._open(), body, link)
        status = self._submit(
            command, capi.CMD_GET_DYNAMICS_INFO_COMPLETED, "report dynamics"
        )
        info = capi.DynamicsInfo()
        capi.dynamics_info(status, byref(info))
        return info

    def joints(self, body: int) -> list[Joint]:
        """The joints of a body, in the order of its URDF."""
        handle = self._open()
        info = capi.JointInfo()
        joints = []
        for index in range(capi.joint_count(handle, body)):
            capi.joint_info(handle, body, index, byref(info))
            name, link = info.joint_name.decode(), info.link_name.decode()
            is_movable = info.u_size == 1
            joints.append(Joint(index, name, link, is_movable, info.damping))
        return joints

    def enable_wrench_sensor(self, body: int, joint: int) -> None:
        """Have the forces through a joint computed in every step."""
        command = capi.physics_init(self._open())
        capi.physics_set_joint_feedback(command, capi.JOINT_FEEDBACK_IN_JOINT_FRAME)
        self._submit(command, capi.CMD_CLIENT_COMMAND_COMPLETED, "set parameters")
        command = capi.sensor_init(self._open(), body)
        capi.sensor_enable_wrench(command, joint, 1)
        self._submit(command, capi.CMD_CLIENT_COMMAND_COMPLETED, "add a sensor")
