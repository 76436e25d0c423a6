"""Loads the library compiled from this folder's C files, and declares its structs.

The comments in the header files explain the fields of the structs. The library is
optional. Without it, `VectorSimulation` steps its clients in Python threads.
"""

import ctypes
import functools
import importlib.util
import os
import shlex
import shutil
import sysconfig
import warnings
from ctypes import (
    POINTER,
    Structure,
    c_char_p,
    c_double,
    c_int,
    c_int64,
    c_void_p,
)
from pathlib import Path
from typing import Any, Literal, get_args

from torch_panda.bullet import capi
from torch_panda.bullet.library import bind

# Version of the C sources, as ``loop_version`` in client.h: the library must have been
# compiled from sources of this version.
VERSION = 6

# "native": threads of C. "ctypes": threads of Python that call Bullet through ctypes.
LoopName = Literal["native", "ctypes"]

# Environment variable that chooses the loop, read whenever a simulation is created.
LOOP_VARIABLE = "TORCH_PANDA_LOOP"

# ``enum arm_mode``
ARM_MODES = {"position": 0, "velocity": 1, "torque": 2}

# Values in the fields of a `Failure` that are not status codes of Bullet.
NO_ANSWER = -1  # in the field "answer": Bullet gave no answer
CLIENT_CLOSED = -2  # in the field "expected": the client was closed before the command
DIVERGED = -3  # in the field "expected": no command failed; the state is not finite

# Bullet's functions that the library calls, in the order of ``struct functions``.
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
        ("num_substeps", c_int),  # substeps taken so far in the present step
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
        ("num_substeps", c_int),  # substeps of a whole step
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


class Library:
    """The functions of the library.

    Calls release the GIL.

    Args:
        path: Path of the compiled file.

    Raises:
        OSError: The file cannot be loaded.
    """

    def __init__(self, path: str) -> None:
        work = ctypes.CDLL(path)
        self.path = path
        try:
            self.version: int = work.loop_version()
        except AttributeError:
            self.version = 0  # the library is older than the version numbers
        if self.version != VERSION:
            return  # do not bind the functions: `loop_name` refuses this library
        integers = POINTER(c_int)
        self.create = bind(work, "loop_create", c_void_p, POINTER(Batch), c_int)
        self.step = bind(
            work,
            "loop_step",
            c_int,
            *(c_void_p, POINTER(Control), c_void_p, integers, c_int),
        )
        self.reset = bind(work, "loop_reset", c_int, c_void_p, integers, c_int)
        self.reset_one = bind(work, "client_reset", c_int, POINTER(Batch), c_int)
        self.destroy = bind(work, "loop_destroy", None, c_void_p)


def load() -> Library | str:
    """Load the library; return a text with the reason if this is not possible."""
    # The file has the name of an extension module, because setuptools builds it.
    spec = importlib.util.find_spec("torch_panda.bullet._loop")
    if spec is None or spec.origin is None:
        compiler = shlex.split(sysconfig.get_config_var("CC") or "cc")[0]
        if shutil.which(compiler) is None:
            return f"it was not compiled, and there is no C compiler ({compiler!r})"
        return "torch_panda/bullet/_loop*.so does not exist"
    try:
        return Library(spec.origin)
    except OSError as error:
        return f"it cannot be loaded ({error})"


_loaded = load()
LIBRARY = _loaded if isinstance(_loaded, Library) else None
_reason_missing = _loaded if isinstance(_loaded, str) else None


def loop_name() -> LoopName:
    """Name of the loop of a new simulation.

    Without the library, this warns once per process that the Python loop is slower.

    Raises:
        ImportError: The library was compiled from sources of another version.
        ValueError: The environment variable names an unknown loop, or names "native"
            although there is no library.
    """
    name = os.environ.get(LOOP_VARIABLE) or None
    if name not in (None, *get_args(LoopName)):
        raise ValueError(
            f"{LOOP_VARIABLE} must be one of {get_args(LoopName)} or unset, "
            f"got {name!r}"
        )
    if name == "ctypes":
        return "ctypes"
    if LIBRARY is None:
        if name == "native":
            raise ValueError(f"{LOOP_VARIABLE}=native, but {loop_problem()}")
        _warn_of_slow_loop()
        return "ctypes"
    if LIBRARY.version != VERSION:
        raise ImportError(loop_problem())
    return "native"


def loop_problem() -> str | None:
    """Why the native loop cannot run, and how to fix this; None if it can run."""
    if LIBRARY is None:
        return (
            f"torch_panda has no compiled loop: {_reason_missing}. With a C compiler "
            f"installed, compile it: {_reinstall_command()}"
        )
    if LIBRARY.version != VERSION:
        return (
            f"the compiled loop {LIBRARY.path} has version {LIBRARY.version}, but the "
            f"sources of torch_panda have version {VERSION}. Compile it again: "
            f"{_reinstall_command()}"
        )
    return None


@functools.cache  # once per process
def _warn_of_slow_loop() -> None:
    warnings.warn(
        f"steps take about 1.5 times as long as they could, because {loop_problem()}. "
        f"{LOOP_VARIABLE}=ctypes silences this warning",
        RuntimeWarning,
        stacklevel=2,
    )


def _reinstall_command() -> str:
    root = Path(__file__).parents[2]
    if (root / "pyproject.toml").is_file():
        return f"pip install --no-deps -e {root}"
    return "pip install --no-deps --force-reinstall --no-cache-dir torch_panda"


def bullet_functions() -> Any:  # noqa: ANN401 (a ctypes array)
    """``struct functions``: the addresses of Bullet's functions."""
    return Functions(*(ctypes.cast(f, c_void_p).value for f in _BULLET))
