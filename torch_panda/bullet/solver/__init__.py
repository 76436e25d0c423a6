"""A faster constraint solver for Bullet, with the same results bit for bit.

`activate` replaces four of Bullet's functions in this process, if all conditions of
`gate.py` hold. All clients of the process then run the replacements, a user's own
pybullet clients too. Each C file lists Bullet's functions for which it stands, and the
reason why its results are the same.
"""

from torch_panda.bullet.solver.gate import (
    SOLVER_VARIABLE,
    SolverName,
    SolverStatus,
    activate,
)

__all__ = ["SOLVER_VARIABLE", "SolverName", "SolverStatus", "activate"]
