"""How finely, and how exactly, Bullet integrates."""

import math
import operator
from dataclasses import dataclass
from typing import Literal, get_args

PhysicsName = Literal["exact", "fast"]


@dataclass(frozen=True)
class PhysicsParams:
    """Parameters of the physics; the defaults are those of panda-gym 3.0.7.

    The control frequency is 1 / (``timestep`` * ``n_substeps``), 25 Hz by default.
    Motors move joints by ``position_gain`` of the remaining error a substep: with
    other substeps, another gain keeps the arm as quick, about 1 - 0.9 ** (20 / n).

    Args:
        timestep: length of one substep [s].
        n_substeps: substeps per step.
        solver_iterations: the most iterations of the constraint solver in a substep.
        residual_threshold: the solver stops early at a smaller squared residual.
        position_gain: part of the error that a joint's motor removes in a substep.
        gravity: along the world's z axis [m/s^2].
        ik_iterations: the most iterations of the inverse kinematics in a step. The
            default, Bullet's, stops short of the pose by about 13 mm of 50; fewer of
            them that go as far have less damping, about in proportion.
        ik_damping: damping of their least squares, greater than 0.

    Raises:
        ValueError: an argument is out of range.
    """

    timestep: float = 1 / 500
    n_substeps: int = 20
    solver_iterations: int = 50
    residual_threshold: float = 1e-7
    position_gain: float = 0.1
    gravity: float = -9.81
    ik_iterations: int = 20
    ik_damping: float = 0.5

    def __post_init__(self) -> None:
        for name in ("n_substeps", "solver_iterations", "ik_iterations"):
            value = getattr(self, name)
            if operator.index(value) < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        if not 0 < self.timestep < math.inf:
            raise ValueError(f"timestep must be positive [s], got {self.timestep}")
        if not 0 <= self.residual_threshold < math.inf:
            raise ValueError(
                f"residual_threshold must not be negative, "
                f"got {self.residual_threshold}"
            )
        if not 0 < self.position_gain <= 1:
            raise ValueError(
                f"position_gain must lie in (0, 1], got {self.position_gain}"
            )
        if not 0 < self.ik_damping < math.inf:
            raise ValueError(f"ik_damping must be positive, got {self.ik_damping}")
        if not math.isfinite(self.gravity):
            raise ValueError(f"gravity must be finite, got {self.gravity}")

    @property
    def ctrl_dt(self) -> float:
        """Length of one step, in which a robot is controlled once [s]."""
        return self.timestep * self.n_substeps


EXACT = PhysicsParams()
# 12 substeps for 20. The solver needs all its iterations where fingers hold a cube, and
# few elsewhere: a larger residual saves as much as a limit of 10 iterations does, but
# not where they matter. A motor leaves 1 - gain of the error a substep; this gain,
# somewhat more than 1 - 0.9 ** (20 / 12) = 0.161, makes a puck that the scripted expert
# strikes slide as far as it does in exact physics, to about 1 %; other strikes, not.
# 5 iterations of the inverse kinematics with this damping end within 0.003 rad, on
# average, of the joints that 20 of the default's find.
FAST = PhysicsParams(
    timestep=1 / 300,
    n_substeps=12,
    residual_threshold=1e-3,
    position_gain=0.176,
    ik_iterations=5,
    ik_damping=0.1125,
)

_NAMED: dict[str, PhysicsParams] = {"exact": EXACT, "fast": FAST}


def read_physics(physics: "PhysicsParams | PhysicsName") -> PhysicsParams:
    """The parameters of a name, or the parameters themselves.

    Raises:
        ValueError: there is no such name.
    """
    if isinstance(physics, PhysicsParams):
        return physics
    if physics not in _NAMED:
        raise ValueError(
            f"physics must be PhysicsParams or one of {get_args(PhysicsName)}, "
            f"got {physics!r}"
        )
    return _NAMED[physics]
