"""The state of a body as Bullet reports it, in views of Bullet's memory.

The views are valid until the client's next command, so copy the numbers that you want
to keep. All numbers are float64. Poses and velocities are in the world frame.
"""

from ctypes import byref, c_double, c_int, c_void_p

import numpy as np
import numpy.typing as npt

from torch_panda.bullet import capi

Doubles = npt.NDArray[np.float64]

# In Bullet's coordinates q and u, the joints follow the base. The pose of the base has
# 7 numbers, and its velocity has 6.
Q_OFFSET = 7
U_OFFSET = 6

_DOUBLE = 8  # bytes


def _view(address: int | None, first: int, *shape: int) -> Doubles:
    """A view of an array of doubles in Bullet's memory, from index ``first`` on."""
    assert address is not None  # the status was checked
    count = shape[0] if len(shape) == 1 else shape[0] * shape[1]
    array = (c_double * count).from_address(address + _DOUBLE * first)
    view: Doubles = np.ctypeslib.as_array(array)
    return view if len(shape) == 1 else view.reshape(shape)


class BodyState:
    """The state of a body with n joints of one degree of freedom and m links.

    Args:
        status: Handle of Bullet's answer to a request for the state.
    """

    def __init__(self, status: int) -> None:
        self._status = status
        q_size = c_int()
        q, u, poses, velocities = c_void_p(), c_void_p(), c_void_p(), c_void_p()
        capi.state_result(
            status,
            None,
            None,
            byref(q_size),
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
        self._num_joints = q_size.value - Q_OFFSET
        self._q, self._u = q.value, u.value
        self._poses, self._velocities = poses.value, velocities.value

    @property
    def base_pose(self) -> Doubles:
        """Pose of the base (7,): position [m] and quaternion xyzw."""
        return _view(self._q, 0, 7)

    @property
    def base_velocity(self) -> Doubles:
        """Velocity of the base (6,): linear [m/s] and angular [rad/s]."""
        return _view(self._u, 0, 6)

    @property
    def joint_positions(self) -> Doubles:
        """Positions of the joints (n,) [rad] or [m]."""
        return _view(self._q, Q_OFFSET, self._num_joints)

    @property
    def joint_velocities(self) -> Doubles:
        """Velocities of the joints (n,) [rad/s] or [m/s]."""
        return _view(self._u, U_OFFSET, self._num_joints)

    def link_pose(self, link: int) -> Doubles:
        """Pose of a link's centre of mass (7,): position [m], quaternion xyzw."""
        return _view(self._poses, 7 * link, 7)

    def link_velocity(self, link: int) -> Doubles:
        """Velocity of a link's centre of mass (6,), if velocities were requested."""
        return _view(self._velocities, 6 * link, 6)

    @property
    def link_poses(self) -> Doubles:
        """Poses of the links' centres of mass (m, 7)."""
        return _view(self._poses, 0, self._read_forces()[0], 7)

    @property
    def wrenches(self) -> Doubles:
        """Wrench that each link got from its parent link in the last substep (m, 6).

        A wrench is a force [N] and a torque [N m]. It acts at the joint between the two
        links and is given in the child link's frame. It is zero unless the joint has a
        wrench sensor.
        """
        num_links, wrenches, _ = self._read_forces()
        return _view(wrenches, 0, num_links, 6)

    @property
    def motor_forces(self) -> Doubles:
        """Torques [N m] or forces [N] of the motors in the last substep (m,)."""
        num_links, _, motors = self._read_forces()
        return _view(motors, 0, num_links)

    def _read_forces(self) -> tuple[int, int | None, int | None]:
        """Number of links, address of the wrenches, and address of the motor forces."""
        links, wrenches, motors = c_int(), c_void_p(), c_void_p()
        unused = (None,) * 5
        capi.state_result(
            self._status,
            None,
            byref(links),
            *unused,
            byref(wrenches),
            None,
            byref(motors),
            None,
            None,
        )
        return links.value, wrenches.value, motors.value
