"""Parameters of Bullet's integration: time step, solver, motors, gravity."""

import math
from dataclasses import dataclass
from typing import Literal, get_args

from torch_panda.checks import check_finite, check_integer, check_not_negative

PhysicsName = Literal["exact", "fast"]


@dataclass(frozen=True)
class PhysicsParams:
    """Parameters of the physics; the defaults are those of panda-gym 3.0.7.

    The control frequency is 1 / (``timestep`` * ``n_substeps``), 25 Hz by default.

    In every substep, a motor removes the share ``position_gain`` of its joint's
    position error. The default, 0.1 in each of 20 substeps, leaves 0.9 ** 20 of the
    error after a step. With n substeps, a gain of about 1 - 0.9 ** (20 / n) leaves as
    much, so that the arm moves as fast.

    Args:
        timestep: Length of a substep [s].
        n_substeps: Number of substeps per step.
        solver_iterations: Maximum number of iterations of the constraint solver in a
            substep.
        residual_threshold: The solver stops early when the squared residual is smaller.
        position_gain: Share of a joint's position error that its motor removes in a
            substep.
        gravity: Gravity along the world's z axis [m/s^2].
        ik_iterations: Maximum number of iterations of the inverse kinematics in a step.
            With the defaults of this and of ``ik_damping``, which are Bullet's own, the
            arm stops about 13 mm short of a target that is 50 mm away. Fewer iterations
            get as close if ``ik_damping`` is reduced by about the same factor.
        ik_damping: Damping of the inverse kinematics, which Bullet solves by damped
            least squares.

    Raises:
        ValueError: An argument is out of range.
        TypeError: An argument is not a number, or not an integer where it counts.
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
        check_finite(**vars(self))
        for name in ("n_substeps", "solver_iterations", "ik_iterations"):
            value = getattr(self, name)
            if check_integer(name, value) < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        if not 0 < self.timestep < math.inf:
            raise ValueError(
                f"timestep must be positive and finite [s], got {self.timestep}"
            )
        check_not_negative(residual_threshold=self.residual_threshold)
        if not 0 < self.position_gain <= 1:
            raise ValueError(
                f"position_gain must lie in (0, 1], got {self.position_gain}"
            )
        if not 0 < self.ik_damping < math.inf:
            raise ValueError(
                f"ik_damping must be positive and finite, got {self.ik_damping}"
            )

    @property
    def ctrl_dt(self) -> float:
        """Length of a step, in which a robot is controlled once [s]."""
        return self.timestep * self.n_substeps


EXACT = PhysicsParams()
FAST = PhysicsParams(
    timestep=1 / 300,
    n_substeps=12,
    # The solver needs all its iterations only while the fingers hold a cube. With this
    # larger threshold, it stops early at all other times. This saves the same time as
    # a maximum of 10 iterations, and does not weaken the grasp.
    residual_threshold=1e-3,
    # The formula of `PhysicsParams` gives 1 - 0.9 ** (20 / 12) = 0.161. With this
    # larger gain, a puck that the scripted expert strikes slides as far as in exact
    # physics, to about 1 %. Other strikes differ more.
    position_gain=0.176,
    # The joint positions differ on average by 0.003 rad from those of 20 iterations
    # with the default damping.
    ik_iterations=5,
    ik_damping=0.1125,
)

_NAMED: dict[str, PhysicsParams] = {"exact": EXACT, "fast": FAST}


def resolve_physics(physics: "PhysicsParams | PhysicsName") -> PhysicsParams:
    """Look up a preset by its name; `PhysicsParams` are returned unchanged.

    Raises:
        ValueError: There is no preset of this name.
    """
    if isinstance(physics, PhysicsParams):
        return physics
    if physics not in _NAMED:
        raise ValueError(
            f"physics must be PhysicsParams or one of {get_args(PhysicsName)}, "
            f"got {physics!r}"
        )
    return _NAMED[physics]
