"""Euler angles of a quaternion."""

import math


def euler_angles(x: float, y: float, z: float, w: float) -> tuple[float, float, float]:
    """Roll, pitch and yaw [rad] of a quaternion xyzw.

    Equals pybullet's ``getEulerFromQuaternion``. Near a pitch of 90 degrees only the
    sum or the difference of roll and yaw is defined, and roll is 0. ``client.c`` has
    the same function in C.
    """
    sine = -2 * (x * z - w * y)
    if abs(sine) >= 0.99999:
        side = math.copysign(1.0, sine)
        return 0.0, side * (math.pi / 2), 2 * math.atan2(-side * x, side * y)
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    roll = math.atan2(2 * (y * z + w * x), ww - xx - yy + zz)
    yaw = math.atan2(2 * (x * y + w * z), ww + xx - yy - zz)
    return roll, math.asin(sine), yaw
