"""The state of a body as Bullet reports it, in views of Bullet's memory.

The views are valid until the client's next command, so copy the numbers that you want
to keep. All numbers are float64. Poses and velocities are in the world frame.
"""

import math
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


def _view(pointer: c_void_p, first: int, *shape: int) -> Doubles:
    """A view of an array of doubles in Bullet's memory, from index ``first`` on."""
    assert pointer.value is not None  # the status was checked
    array = (c_double * math.prod(shape)).from_address(pointer.value + _DOUBLE * first)
    return np.ctypeslib.as_array(array).reshape(shape)


class BodyState:
    """The state of a body with n joints of one degree of freedom and m links.

    Args:
        status: Handle of Bullet's answer to a request for the state.
    """

    def __init__(self, status: int) -> None:
        num_links, q_size = c_int(), c_int()
        self._q, self._u = c_void_p(), c_void_p()
        self._wrenches, self._motor_forces = c_void_p(), c_void_p()
        self._poses = c_void_p()
        capi.state_result(
            status,
            None,
            byref(num_links),
            byref(q_size),
            None,
            None,
            byref(self._q),
            byref(self._u),
            byref(self._wrenches),
            None,
            byref(self._motor_forces),
            byref(self._poses),
            None,
        )
        self._num_links = num_links.value
        self._num_joints = q_size.value - Q_OFFSET

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

    @property
    def link_poses(self) -> Doubles:
        """Poses of the links' centres of mass (m, 7)."""
        return _view(self._poses, 0, self._num_links, 7)

    @property
    def wrenches(self) -> Doubles:
        """Wrench that each link got from its parent link in the last substep (m, 6).

        A wrench is a force [N] and a torque [N m]. It acts at the joint between the two
        links and is given in the child link's frame. It is zero unless the joint has a
        wrench sensor. A reset keeps the numbers of the last substep before it.
        """
        return _view(self._wrenches, 0, self._num_links, 6)

    @property
    def motor_forces(self) -> Doubles:
        """Torques [N m] or forces [N] of the motors in the last substep (m,).

        A reset keeps the numbers of the last substep before it.
        """
        return _view(self._motor_forces, 0, self._num_links)
