"""The structs of ``csrc/functions.h`` and ``csrc/client.h``, which explain them."""

import ctypes
from ctypes import POINTER, Structure, c_char_p, c_double, c_int, c_int64, c_void_p
from typing import Any

from torch_panda.bullet import capi

# Bullet's functions by name, in the order of ``struct functions``. C code calls them
# through this table of addresses.
FUNCTIONS: dict[str, Any] = {
    name: function
    for name, function in vars(capi).items()
    if isinstance(function, ctypes._CFuncPtr)  # type: ignore[attr-defined]
}
Functions = c_void_p * len(FUNCTIONS)

# ``enum arm_mode``
ARM_MODES = {"position": 0, "velocity": 1, "torque": 2}

# Values in the fields of a `Failure` that are not status codes of Bullet.
NO_ANSWER = -1  # in the field "answer": Bullet gave no answer
CLIENT_CLOSED = -2  # in the field "expected": the client was closed before the command


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
        ("links", POINTER(Link)),
        ("pair_size", c_int),
        ("pair", c_int * 2),
    )


class Client(Structure):
    """``struct client``."""

    _fields_ = (
        ("handle", c_void_p),
        ("num_detections", c_int64),
        ("has_diverged", c_int),
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
        ("has_orientation", c_int),
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


def bullet_functions() -> Any:  # noqa: ANN401 (a ctypes array)
    """``struct functions``: the addresses of Bullet's functions."""
    return Functions(
        *(ctypes.cast(function, c_void_p).value for function in FUNCTIONS.values())
    )
