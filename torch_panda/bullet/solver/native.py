"""The compiled C library of the packed solver: loading and structs."""

import ctypes
from collections.abc import Sequence
from ctypes import POINTER, Structure, c_char_p, c_double, c_int, c_void_p
from typing import NamedTuple

# Version of the C sources, as in hook.c: the library must have been compiled from
# sources of this version.
VERSION = 8

# ``enum mode`` in hook.c. A thread in the mode FOLLOW runs Bullet's functions or the
# replacements, as `SolverLibrary.enable` chose. PROBE checks Bullet's layout, SOLVE
# always runs the replacements, and LEAVE always runs Bullet's functions.
FOLLOW, PROBE, SOLVE, LEAVE = range(4)

# ``enum btMultibodyLink::eFeatherstoneJointType``
REVOLUTE, PRISMATIC, FIXED = 0, 1, 4


class IncompatibleError(Exception):
    """The solver does not fit this process; see ``compat.py``."""


class Replacement(NamedTuple):
    """One of Bullet's functions that is replaced.

    Attributes:
        table: Address in the vtable to which objects of the class point.
        slot: Address of the function's slot in the table.
        function: Address of Bullet's function.
    """

    table: int
    slot: int
    function: int


class Expectation(Structure):
    """``struct expectation``."""

    _fields_ = (
        ("motor_table", c_void_p),
        ("limit_table", c_void_p),
        ("time_step", c_double),
        ("residual_threshold", c_double),
        ("motor_impulse", c_double),
        ("friction", c_double),
        ("restitution", c_double),
        ("masses", c_double * 2),
        ("num_iterations", c_int),
        ("num_dofs", c_int),
        ("num_links", c_int),
        ("joint_types", POINTER(c_int)),
        ("kp", c_double),
        ("kd", c_double),
        ("num_bodies", c_int),
        ("link_masses", POINTER(c_double)),
        ("gravity", c_double),
        ("joint_damping", c_double),
        ("damping", c_double),
        ("max_velocity", c_double),
        ("table_size", c_double),
        ("target", c_double * 7),
        ("ik_damping", c_double),
        ("ik_iterations", c_int),
    )


class Counts(Structure):
    """``struct counts``."""

    _fields_ = (
        ("groups", c_int),
        ("bullet_groups", c_int),
        ("joints", c_int),
        ("bullet_joints", c_int),
        ("manifolds", c_int),
        ("bullet_manifolds", c_int),
        ("bodies", c_int),
        ("bullet_bodies", c_int),
        ("answers", c_int),
        ("bullet_answers", c_int),
        ("aabbs", c_int),
        ("bullet_aabbs", c_int),
        ("snapshots", c_int),
        ("bullet_snapshots", c_int),
        ("joint_rows", c_int),
        ("contact_rows", c_int),
        ("spinning_rows", c_int),
        ("mismatch", c_char_p),
    )


class SolverLibrary:
    """The functions of the library.

    Args:
        path: Path of the compiled file.

    Raises:
        IncompatibleError: The library was compiled from sources of another version.
    """

    def __init__(self, path: str) -> None:
        functions = ctypes.PyDLL(path)  # the calls are cheap, so keep the GIL
        try:
            version = functions.solver_version()
        except AttributeError:
            version = 0  # the library is older than the version numbers
        if version != VERSION:
            raise IncompatibleError(
                f"the compiled solver {path} has version {version}, but the sources of "
                f"torch_panda have version {VERSION}: install torch_panda again"
            )
        self._install = functions.solver_install
        self._install.argtypes = (c_void_p, c_void_p)
        self._uninstall = functions.solver_uninstall
        self._uninstall.restype = None
        self._enable = functions.solver_enable
        self._enable.argtypes = (c_int,)
        self._enable.restype = None
        self._set_mode = functions.solver_set_mode
        self._set_mode.argtypes = (c_int, POINTER(Expectation))
        self._set_mode.restype = None
        self._counts = functions.solver_counts
        self._counts.argtypes = (POINTER(Counts),)
        self._counts.restype = None

    def install(self, replacements: Sequence[Replacement]) -> None:
        """Replace Bullet's functions in their slots.

        Raises:
            IncompatibleError: The system does not let a vtable be written.
        """
        addresses = c_void_p * len(replacements)
        slots = addresses(*(replacement.slot for replacement in replacements))
        functions = addresses(*(replacement.function for replacement in replacements))
        if self._install(slots, functions):
            raise IncompatibleError(
                "a table of virtual functions cannot be made writable"
            )

    def uninstall(self) -> None:
        """Put Bullet's functions back into their slots."""
        self._uninstall()

    def enable(self, on: bool) -> None:
        """Choose whether threads in the mode FOLLOW use the replacement."""
        self._enable(on)

    def set_mode(self, mode: int, expectation: Expectation | None = None) -> None:
        """Set the mode of the calling thread, and reset its counts to zero."""
        self._set_mode(mode, expectation)

    def counts(self) -> Counts:
        """Counts of the calling thread since its mode was set."""
        counts = Counts()
        self._counts(counts)
        return counts
