"""A faster constraint solver for Bullet, with the same results bit for bit.

`activate` replaces one of Bullet's functions in this process, if every condition of
the gate holds; see `gate.py`. All clients of the process then run the replacement, a
user's own pybullet clients too. ``iterations.c`` explains what it does, and why the
results are the same.
"""

from torch_panda.bullet.solver.gate import (
    SOLVER_VARIABLE,
    SolverName,
    SolverStatus,
    activate,
)

__all__ = ["SOLVER_VARIABLE", "SolverName", "SolverStatus", "activate"]
