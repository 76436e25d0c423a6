"""Decides whether torch_panda's solver replaces Bullet's, and installs it if so.

The solver of torch_panda is called "packed", because it packs the constraint rows
into contiguous memory. It depends on the layout of Bullet's objects in memory, and is
used only if all of these conditions hold; otherwise Bullet's own functions run:

1. ``TORCH_PANDA_SOLVER`` is not ``bullet``.
2. The process runs on x86-64 Linux. Compilers for other platforms fuse a multiplication
   with an addition, which rounds differently.
3. The installed pybullet has the supported version.
4. The C library of the solver was compiled, from sources of this version.
5. pybullet's extension module has the symbols that are needed, and each table of
   virtual functions (vtable) has exactly one slot with the function to replace.
6. In a known scene, Bullet's objects have the layout that ``bullet_types.h`` declares.
7. In the same scene, Bullet and the replacement compute the same states, bit for bit.

The self-test checks the last two conditions; see ``self_test.py``. Until it has passed,
only the thread of the self-test runs the replacement.

To replace a function means to store another pointer in a slot of a vtable, which is
data. No machine code is changed.
"""

import ctypes
import importlib.metadata
import os
import platform
import sys
import threading
from ctypes import c_void_p
from pathlib import Path
from typing import Literal, NamedTuple

from torch_panda.bullet import library
from torch_panda.bullet.solver.elf import read_symbols
from torch_panda.bullet.solver.native import (
    IncompatibleError,
    Replacement,
    SolverLibrary,
)
from torch_panda.bullet.solver.self_test import run_self_test

SolverName = Literal["packed", "bullet"]

# Environment variable, read when the first client of the process is created.
SOLVER_VARIABLE = "TORCH_PANDA_SOLVER"

# setuptools gives the library this name, see pyproject.toml.
_LIBRARY = Path(__file__).with_name("_solver.abi3.so")
_SOLVER = "_ZTV27btMultiBodyConstraintSolver"
_MOTOR = "_ZTV21btMultiBodyJointMotor"
_LIMIT = "_ZTV31btMultiBodyJointLimitConstraint"
_WORLD = "_ZTV28btSoftMultiBodyDynamicsWorld"
_SERVER = "_ZTV29PhysicsServerCommandProcessor"
_BROAD_PHASE = "_ZTV16btDbvtBroadphase"
_CREATE_ROWS = (
    "20createConstraintRowsER20btAlignedObjectArrayI27btMultiBodySolverConstraint"
    "ER23btMultiBodyJacobianDataRK19btContactSolverInfo"
)
# The vtables and the functions in them to replace, as mangled names, in the order of
# hook.c.
_REPLACED = (
    (
        _SOLVER,
        "_ZN35btSequentialImpulseConstraintSolver33solveGroupCacheFriendlyIterations"
        "EPP17btCollisionObjectiPP20btPersistentManifoldiPP17btTypedConstrainti"
        "RK19btContactSolverInfoP12btIDebugDraw",
    ),
    (
        _SOLVER,
        "_ZN27btMultiBodyConstraintSolver15convertContactsEPP20btPersistentManifoldi"
        "RK19btContactSolverInfo",
    ),
    (_MOTOR, "_ZN21btMultiBodyJointMotor" + _CREATE_ROWS),
    (_LIMIT, "_ZN31btMultiBodyJointLimitConstraint" + _CREATE_ROWS),
    (
        _WORLD,
        "_ZN24btMultiBodyDynamicsWorld19solveExternalForcesER19btContactSolverInfo",
    ),
    (
        _SERVER,
        "_ZN29PhysicsServerCommandProcessor14processCommandERK19SharedMemoryCommand"
        "R18SharedMemoryStatusPci",
    ),
    (_WORLD, "_ZN16btCollisionWorld11updateAabbsEv"),
    (
        _BROAD_PHASE,
        "_ZN16btDbvtBroadphase7setAabbEP17btBroadphaseProxyRK9btVector3S4_"
        "P12btDispatcher",
    ),
    (
        _WORLD,
        "_ZN24btMultiBodyDynamicsWorld20serializeMultiBodiesEP12btSerializer",
    ),
)
# ctypes knows the address of this exported function. That address minus the function's
# address in the file is where pybullet's extension module was loaded.
_EXPORTED = "b3ConnectPhysicsDirect"


class SolverStatus(NamedTuple):
    """The solver that steps the clients of this process.

    Attributes:
        name: "packed" is torch_panda's solver, "bullet" is Bullet's own.
        reason: Why Bullet's own solver runs; empty for "packed".
    """

    name: SolverName
    reason: str = ""

    def __str__(self) -> str:
        if self.name == "packed":
            return "packed: faster than Bullet's own, equal bit for bit"
        return f"bullet: {self.reason}"


def activate() -> SolverStatus:
    """Replace Bullet's solver in this process if all conditions of this module hold.

    The first call that raises no error decides. Later calls return its result.

    Raises:
        ValueError: The environment variable names an unknown solver.
        RuntimeError: The environment variable demands "packed", and a condition does
            not hold.
    """
    global _status
    if _status is None:
        with _lock:
            if _status is None:
                _status = _decide()
    return _status


_status: SolverStatus | None = None
_lock = threading.Lock()


def _decide() -> SolverStatus:
    choice = os.environ.get(SOLVER_VARIABLE) or None
    if choice not in (None, "packed", "bullet"):
        raise ValueError(
            f'{SOLVER_VARIABLE} must be "packed" or "bullet", got "{choice}"'
        )
    if choice == "bullet":
        return SolverStatus("bullet", f"{SOLVER_VARIABLE}=bullet")
    try:
        enable_if_compatible()
    except IncompatibleError as error:
        if choice == "packed":
            raise RuntimeError(
                f"{SOLVER_VARIABLE}=packed, but {error}; unset it to run Bullet's own "
                f"solver"
            ) from None
        return SolverStatus("bullet", str(error))
    return SolverStatus("packed")


def enable_if_compatible() -> None:
    """Check conditions 2 to 7, and enable the replacement.

    Raises:
        IncompatibleError: A condition does not hold. Bullet's own functions run.
    """
    check_platform()
    check_version()
    solver = load_library()
    replacements = find_replacements(library.library_path())
    tables = {
        name: replacement.table
        for (name, _), replacement in zip(_REPLACED, replacements, strict=True)
    }
    solver.install(replacements)
    try:
        run_self_test(solver, motor_table=tables[_MOTOR], limit_table=tables[_LIMIT])
    except BaseException:  # also Ctrl-C: the next call checks all conditions again
        solver.uninstall()
        raise
    solver.enable(True)


def check_platform() -> None:
    """Check for x86-64 Linux."""
    if sys.platform != "linux" or platform.machine() != "x86_64":
        raise IncompatibleError(
            f"the packed solver needs x86-64 Linux, and this is {sys.platform} on "
            f"{platform.machine()}"
        )


def check_version() -> None:
    """Check for the supported version of pybullet."""
    try:
        version = importlib.metadata.version("pybullet")
    except importlib.metadata.PackageNotFoundError:
        version = "an unknown version"
    if version != library.SUPPORTED_VERSION:
        raise IncompatibleError(
            f"the packed solver needs pybullet {library.SUPPORTED_VERSION}, and "
            f"{version} is installed"
        )


def load_library() -> SolverLibrary:
    """Load the compiled library."""
    if not _LIBRARY.is_file():
        raise IncompatibleError(
            "the packed solver is not compiled: install torch_panda again"
        )
    return SolverLibrary(str(_LIBRARY))


def find_replacements(path: str) -> list[Replacement]:
    """Find the functions to replace, in the order of ``hook.c``.

    Args:
        path: Path of pybullet's extension module.
    """
    names = {name for names in _REPLACED for name in names} | {_EXPORTED}
    try:
        symbols = read_symbols(path, names)
    except ValueError as error:
        raise IncompatibleError(str(error)) from None
    for name in sorted(names):
        if name not in symbols:
            raise IncompatibleError(f"pybullet has no symbol {name}")
    exported = ctypes.cast(getattr(library.WORK, _EXPORTED), c_void_p).value
    assert exported is not None
    base = exported - symbols[_EXPORTED].address
    replacements = []
    for table_name, function_name in _REPLACED:
        function = base + symbols[function_name].address
        table = base + symbols[table_name].address
        entries = (c_void_p * (symbols[table_name].size // 8)).from_address(table)
        slots = [i for i, entry in enumerate(entries) if entry == function]
        if len(slots) != 1:
            raise IncompatibleError(
                f"{table_name} holds the function to replace {len(slots)} times, "
                f"expected once"
            )
        # The first two words of a vtable are not functions. Objects point to the third.
        replacements.append(Replacement(table + 16, table + 8 * slots[0], function))
    return replacements
