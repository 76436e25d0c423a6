"""Faster dynamics, kinematics, broad phase and snapshots, equal bit for bit.

`activate` replaces nine of Bullet's functions in this process if all conditions of
``compat.py`` hold. From then on, all clients of the process run the replacements, also
clients that a user opened with pybullet. Each C file lists which of Bullet's functions
it reimplements, and explains why its results are the same.
"""

from torch_panda.bullet.solver.compat import (
    SOLVER_VARIABLE,
    SolverName,
    SolverStatus,
    activate,
)

__all__ = ["SOLVER_VARIABLE", "SolverName", "SolverStatus", "activate"]
