"""The C library of the replacement, as the installation compiled it."""

import ctypes
from ctypes import POINTER, Structure, c_char_p, c_double, c_int, c_void_p

# ``enum mode``
FOLLOW, PROBE, SOLVE, LEAVE = range(4)


class GateError(Exception):
    """A condition of the gate does not hold."""


class Expectation(Structure):
    """``struct expectation``."""

    _fields_ = (
        ("time_step", c_double),
        ("residual_threshold", c_double),
        ("motor_impulse", c_double),
        ("friction", c_double),
        ("num_iterations", c_int),
        ("num_dofs", c_int),
    )


class Counts(Structure):
    """``struct counts``."""

    _fields_ = (
        ("solved", c_int),
        ("left", c_int),
        ("joint_rows", c_int),
        ("contact_rows", c_int),
        ("spinning_rows", c_int),
        ("wrong", c_char_p),
    )


class SolverLibrary:
    """The C library of the replacement.

    Args:
        path: Path of the compiled file.
    """

    def __init__(self, path: str) -> None:
        functions = ctypes.PyDLL(path)  # cheap calls
        self._install = functions.solver_install
        self._install.argtypes = (c_void_p, c_void_p)
        self._uninstall = functions.solver_uninstall
        self._enable = functions.solver_enable
        self._enable.argtypes = (c_int,)
        self._enable.restype = None
        self._set_mode = functions.solver_set_mode
        self._set_mode.argtypes = (c_int, POINTER(Expectation))
        self._set_mode.restype = None
        self._counts = functions.solver_counts
        self._counts.argtypes = (POINTER(Counts),)
        self._counts.restype = None

    def install(self, slot: int, function: int) -> None:
        """Replace Bullet's function in a slot of the table of virtual functions.

        Raises:
            GateError: The system does not make the table writable.
        """
        if self._install(slot, function):
            raise GateError("the table of virtual functions cannot be made writable")

    def uninstall(self) -> None:
        """Put Bullet's function back into its slot."""
        self._uninstall()

    def enable(self, on: bool) -> None:
        """Choose the solver of all threads that have no mode of their own."""
        self._enable(on)

    def set_mode(self, mode: int, expectation: Expectation | None = None) -> None:
        """Set the mode of the calling thread, and start its counts."""
        self._set_mode(mode, expectation)

    def counts(self) -> Counts:
        """Counts of the calling thread since its mode was set."""
        counts = Counts()
        self._counts(counts)
        return counts
