"""Physics that are drawn anew for every episode."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from torch_panda.bullet import PhysicsClient, PhysicsParams, Scene

Range = tuple[float, float]
_Nominal = Callable[[int, int], float]  # of a body and a link

# What the numbers of ``physics_parameters`` are, in this order.
PARAMETERS = (
    "object_mass",
    "object_friction",
    "table_friction",
    "finger_friction",
    "object_restitution",
    "joint_damping",
    "gravity",
)

# The place of a factor that is not drawn.
_ALWAYS_1 = -1


@dataclass(frozen=True, kw_only=True)
class Randomization:
    """Ranges from which the physics of every episode are drawn.

    Each is (lowest, highest) of a factor on the number that task, robot or URDF give,
    from which an environment draws uniformly before each of its episodes; what it draws
    depends on (seed, environment, number of the episode) only. None leaves a number as
    it is, and what a scene does not have is drawn in vain.

    Attributes:
        object_mass: of all objects, their inertia with it.
        object_friction: lateral, of all objects and their links. Bullet multiplies
            those of two bodies that touch.
        table_friction: lateral, of the table and whatever else stands fixed.
        finger_friction: lateral, of the robot's ``finger_links``.
        object_restitution: of all objects. Where it is 0, as Bullet's is, what is drawn
            is the restitution itself; the table's is then 1, so that objects bounce
            off it by that much.
        joint_damping: of the robot's joints. Where it is 0, as the Panda's is, what is
            drawn is the damping itself [N m s/rad].
        gravity: of the world.
        joint_position: the arm's joints start up to so far from neutral [rad].
        observe: whether ``physics_parameters`` are observed, float32 (*batch, k): the
            factors that are drawn, in the order above.

    Raises:
        ValueError: a range is no (lowest, highest), not finite or negative.
    """

    object_mass: Range | None = None
    object_friction: Range | None = None
    table_friction: Range | None = None
    finger_friction: Range | None = None
    object_restitution: Range | None = None
    joint_damping: Range | None = None
    gravity: Range | None = None
    joint_position: float = 0.0
    observe: bool = False

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name in PARAMETERS and value is not None:
                _check_range(field.name, value)
        if self.object_mass is not None and not min(self.object_mass) > 0:
            raise ValueError(f"object_mass must be above 0, got {self.object_mass}")
        if not 0 <= self.joint_position < math.inf:
            raise ValueError(
                f"joint_position must be finite and at least 0 [rad], got "
                f"{self.joint_position}"
            )
        if self.observe and not self.names:
            raise ValueError(f"observe=True needs a range of one of {PARAMETERS}")

    @property
    def names(self) -> tuple[str, ...]:
        """What is drawn, in the order of ``physics_parameters``."""
        return tuple(name for name in PARAMETERS if getattr(self, name) is not None)

    def bounds(self) -> npt.NDArray[np.float64]:
        """The lowest and the highest factors, (2, k)."""
        return np.array([getattr(self, name) for name in self.names]).T


class PhysicsFactors:
    """Multiplies the physics of the clients of a simulation.

    Args:
        names: of the factors, among `PARAMETERS`.
        client: any of the clients, in which nothing has been changed.
        scene: what it holds.
        finger_links: of the robot.
        physics: how the clients integrate.
    """

    def __init__(
        self,
        names: Sequence[str],
        client: PhysicsClient,
        scene: Scene,
        finger_links: Sequence[int],
        physics: PhysicsParams,
    ) -> None:
        objects = [(body, k) for body in scene.objects for k in _links(client, body)]
        apart = {scene.robot, *scene.objects, *scene.markers}
        fixed = [(body, -1) for body in client.bodies if body not in apart]
        fingers = [(scene.robot, link) for link in finger_links]
        joints = [(scene.robot, joint) for joint in scene.joints]
        damping = {j.index: j.damping for j in client.joints(scene.robot)}
        places: dict[str, tuple[str, list[tuple[int, int]], _Nominal]] = {
            "object_mass": ("mass", objects, client.mass),
            "object_friction": ("lateral_friction", objects, client.friction),
            "table_friction": ("lateral_friction", fixed, client.friction),
            "finger_friction": ("lateral_friction", fingers, client.friction),
            "object_restitution": ("restitution", objects, client.restitution),
            "joint_damping": ("joint_damping", joints, lambda _, link: damping[link]),
        }
        self._gravity: tuple[int, float] | None = None
        # By body and link: the argument of `set_dynamics`, which factor, times what.
        self._changes: dict[tuple[int, int], list[tuple[str, int, float]]] = {}
        for index, name in enumerate(names):
            if name == "gravity":
                self._gravity = (index, physics.gravity)
                continue
            argument, links, nominal = places[name]
            zero = 1.0 if name in ("object_restitution", "joint_damping") else 0.0
            for link in links:
                if value := nominal(*link) or zero:
                    self._changes.setdefault(link, []).append((argument, index, value))
            if name == "object_restitution":
                for link in fixed:
                    change = ("restitution", _ALWAYS_1, 1.0)
                    self._changes.setdefault(link, []).append(change)

    def apply(self, client: PhysicsClient, factors: Sequence[float]) -> None:
        """Give a client the physics of k factors."""
        factors = (*factors, 1.0)
        for (body, link), changes in self._changes.items():
            values = {name: factors[index] * value for name, index, value in changes}
            client.set_dynamics(body, link, **values)
        if self._gravity is not None:
            index, value = self._gravity
            client.set_gravity(factors[index] * value)


def _links(client: PhysicsClient, body: int) -> range:
    """The base, -1, and the links of a body."""
    return range(-1, len(client.joints(body)))


def _check_range(name: str, value: Range) -> None:
    try:
        low, high = map(float, value)
    except (TypeError, ValueError):
        low, high = math.nan, math.nan
    if not 0 <= low <= high < math.inf:
        raise ValueError(
            f"{name} must be (lowest, highest), finite and at least 0, got {value!r}"
        )
