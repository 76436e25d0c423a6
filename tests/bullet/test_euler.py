"""Euler angles, in Python and in C, equal pybullet's."""

import math
from ctypes import c_double

import numpy as np
import pybullet
from hypothesis import example, given
from hypothesis import strategies as st

from torch_panda.bullet.loop import load_library
from torch_panda.rotations import euler_angles

angle = st.floats(-math.pi, math.pi)


def c_angles(*quaternion):
    angles = (c_double * 3)()
    load_library().euler_angles((c_double * 4)(*quaternion), angles)
    return list(angles)


@given(angle, angle, angle)
@example(0.3, math.pi / 2, 1.0)
@example(0.3, -math.pi / 2, 1.0)
def test_angles_equal_those_of_pybullet(roll, pitch, yaw):
    quaternion = pybullet.getQuaternionFromEuler((roll, pitch, yaw))
    expected = pybullet.getEulerFromQuaternion(quaternion)
    for function in (euler_angles, c_angles):
        np.testing.assert_array_equal(function(*quaternion), expected)
