"""Euler angles, in Python and in C, equal pybullet's."""

import math
from ctypes import c_double

import numpy as np
import pybullet
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torch_panda.bullet.loop import load_library
from torch_panda.rotations import euler_angles

angle = st.floats(-math.pi, math.pi)


def c_angles(*quaternion):
    angles = (c_double * 3)()
    load_library().euler_angles((c_double * 4)(*quaternion), angles)
    return list(angles)


FUNCTIONS = [euler_angles, c_angles]


def assert_equals_pybullet(roll, pitch, yaw):
    quaternion = pybullet.getQuaternionFromEuler((roll, pitch, yaw))
    expected = pybullet.getEulerFromQuaternion(quaternion)
    for function in FUNCTIONS:
        np.testing.assert_array_equal(function(*quaternion), expected)


@given(angle, angle, angle)
def test_angles_equal_those_of_pybullet(roll, pitch, yaw):
    assert_equals_pybullet(roll, pitch, yaw)


@pytest.mark.parametrize("pitch", [math.pi / 2, -math.pi / 2])
@given(roll=angle, yaw=angle)
def test_angles_equal_those_of_pybullet_at_a_vertical_pitch(pitch, roll, yaw):
    assert_equals_pybullet(roll, pitch, yaw)
