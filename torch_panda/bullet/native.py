"""``client.c``, ``reset.c`` and ``loop.c`` as the package's installation compiled them.

They are found, loaded and declared here. They are an optional part: without them,
`VectorSimulation` steps its clients in Python.
"""

import ctypes
import importlib.util
import os
from ctypes import (
    POINTER,
    Structure,
    c_char_p,
    c_double,
    c_int,
    c_int64,
    c_void_p,
)
from typing import Any, Literal, get_args

from torch_panda.bullet import capi

LoopName = Literal["native", "ctypes"]

# Chooses the loop of what is created from now on: for tests and comparisons.
LOOP_VARIABLE = "TORCH_PANDA_LOOP"

# ``enum arm_mode``
ARM_MODES = {"position": 0, "velocity": 1, "torque": 2}

# In a `Failure`, beside status codes.
NO_ANSWER = -1  # as answer
CLIENT_CLOSED = -2  # as expected
DIVERGED = -3  # as expected

# In the order of ``struct functions``.
_BULLET = (
    capi.submit,
    capi.status_type,
    capi.ik_init,
    capi.ik_set_target,
    capi.ik_set_iterations,
    capi.ik_set_damping,
    capi.ik_result,
    capi.motor_init,
    capi.motor_set_position,
    capi.motor_set_velocity,
    capi.motor_set_torque,
    capi.motor_set_kp,
    capi.motor_set_kd,
    capi.motor_set_force,
    capi.step_init,
    capi.state_init,
    capi.state_want_link_velocity,
    capi.state_result,
    capi.load_init,
    capi.load_set_snapshot,
    capi.filter_init,
    capi.filter_set_group_mask,
    capi.detect_init,
    capi.pose_init,
    capi.pose_set_position,
    capi.pose_set_orientation,
    capi.pose_set_linear_velocity,
    capi.pose_set_angular_velocity,
    capi.pose_set_joint_position,
    capi.pose_set_joint_velocity,
)
Functions = c_void_p * len(_BULLET)


class Link(Structure):
    """``struct link``."""

    _fields_ = (
        ("body", c_int),
        ("link", c_int),
        ("group", c_int),
        ("mask", c_int),
        ("snapshot", c_int),
    )


class BroadPhase(Structure):
    """``struct broad_phase``."""

    _fields_ = (
        ("num_detections", c_int64),
        ("cycle", c_int),
        ("away", c_int),
        ("built", c_int),
        ("num_links", c_int),
        ("pair_size", c_int),
        ("pair", c_int * 2),
        ("links", POINTER(Link)),
    )


class Client(Structure):
    """``struct client``."""

    _fields_ = (
        ("handle", c_void_p),
        ("num_detections", c_int64),
        ("num_substeps", c_int),
        ("broad_phase", POINTER(BroadPhase)),
    )


class Scene(Structure):
    """``struct scene``."""

    _fields_ = (
        ("robot", c_int),
        ("ee_link", c_int),
        ("num_joints", c_int),
        ("num_objects", c_int),
        ("num_object_joints", c_int),
        ("num_markers", c_int),
        ("num_substeps", c_int),
        ("joints", POINTER(c_int)),
        ("objects", POINTER(c_int)),
        ("object_joint_counts", POINTER(c_int)),
        ("object_joints", POINTER(c_int)),
        ("markers", POINTER(c_int)),
    )


class Control(Structure):
    """``struct control``."""

    _fields_ = (
        ("ik_link", c_int),
        ("num_arm_joints", c_int),
        ("setpoint_size", c_int),
        ("turns", c_int),
        ("arm_mode", c_int),
        ("ik_iterations", c_int),
        ("orientation", c_double * 4),
        ("position_gain", c_double),
        ("velocity_gain", c_double),
        ("forces", POINTER(c_double)),
        ("ik_damping", POINTER(c_double)),
    )


class Failure(Structure):
    """``struct failure``."""

    _fields_ = (("expected", c_int), ("answer", c_int), ("action", c_char_p))


class Batch(Structure):
    """``struct batch``."""

    _fields_ = (
        ("bullet", POINTER(Functions)),
        ("scene", POINTER(Scene)),
        ("clients", POINTER(POINTER(Client))),
        ("state", c_void_p),
        ("marker_pose", c_void_p),
        ("failures", POINTER(Failure)),
        ("control", POINTER(Control)),
        ("setpoint", c_void_p),
    )


class Library:
    """The functions of all three. Calls release the GIL.

    Args:
        path: of the compiled file.
    """

    def __init__(self, path: str) -> None:
        library = ctypes.CDLL(path)
        self.create = library.loop_create
        self.create.restype = c_void_p
        self.create.argtypes = (POINTER(Batch), c_int)
        self.step = library.loop_step
        self.step.argtypes = (
            c_void_p,
            POINTER(Control),
            c_void_p,
            POINTER(c_int),
            c_int,
        )
        self.reset = library.loop_reset
        self.reset.argtypes = (c_void_p, POINTER(c_int), c_int)
        self.reset_one = library.client_reset
        self.reset_one.argtypes = (POINTER(Batch), c_int)
        self.euler_angles = library.euler_angles
        self.euler_angles.restype = None
        self.euler_angles.argtypes = (POINTER(c_double), POINTER(c_double))
        self.destroy = library.loop_destroy
        self.destroy.restype = None
        self.destroy.argtypes = (c_void_p,)


def _find() -> Library | None:
    # It has the name of an extension module, but knows nothing of Python.
    spec = importlib.util.find_spec("torch_panda.bullet._loop")
    return None if spec is None or spec.origin is None else Library(spec.origin)


LIBRARY = _find()


def loop_name() -> LoopName:
    """The loop that steps what is created now.

    Raises:
        ValueError: the environment variable asks for a loop that there is not.
    """
    name = os.environ.get(LOOP_VARIABLE)
    if name is None:
        return "ctypes" if LIBRARY is None else "native"
    if name == "native" and LIBRARY is None:
        raise ValueError(
            f"{LOOP_VARIABLE}=native, but torch_panda was installed without its native "
            f"loop: install it again where there is a C compiler"
        )
    if name == "ctypes":
        return "ctypes"
    if name == "native":
        return "native"
    raise ValueError(
        f"{LOOP_VARIABLE} must be one of {get_args(LoopName)}, got {name!r}"
    )


def bullet_functions() -> Any:  # noqa: ANN401 (a ctypes array)
    """``struct functions``: where Bullet's functions are."""
    return Functions(*(ctypes.cast(f, c_void_p).value for f in _BULLET))
