"""Domain randomization: each episode has physics parameters drawn at random.

`Randomization` holds the ranges. `PhysicsFactors` multiplies the physics of a client by
factors. `DomainRandomizer` draws the factors of n environments and applies them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_panda.bullet import PhysicsClient, Scene, VectorSimulation
from torch_panda.checks import check_not_negative, check_range, check_rows
from torch_panda.robots import Robot
from torch_panda.sensors import Entry
from torch_panda.tasks import Bodies, Task

Range = tuple[float, float]

# The factors of ``physics_parameters``, in this order.
PARAMETERS = (
    "object_mass",
    "object_friction",
    "table_friction",
    "finger_friction",
    "object_restitution",
    "joint_damping",
    "gravity",
)
# A factor times 0 is 0. So for these parameters, the drawn number replaces a nominal
# value of 0.
_ABSOLUTE_AT_ZERO = ("object_restitution", "joint_damping")

# Entries of a state that determine the physics of an episode.
PHYSICS_SEED = "physics_seed"
PHYSICS_PARAMETERS = "physics_parameters"
PHYSICS_KEYS = (PHYSICS_SEED, PHYSICS_PARAMETERS)

# Index of the constant factor 1, which `PhysicsFactors.apply` appends to the factors.
_CONSTANT = -1


@dataclass(frozen=True, kw_only=True)
class Randomization:
    """Ranges from which the physics parameters of every episode are drawn.

    A range is the lowest and the highest value of a factor. The factor multiplies the
    nominal value, which the task, the robot or the URDF sets. None keeps the nominal
    value. A range for something that the scene lacks has no effect.

    Each environment draws new factors before each of its episodes, uniformly from these
    ranges. The drawn factors depend on (seed, environment, episode number) only.

    Attributes:
        object_mass: Mass of all objects. Bullet computes their inertia from the mass
            and the collision shape, even where a URDF has another inertia.
        object_friction: Lateral friction of all objects and their links. For a
            contact, Bullet multiplies the frictions of the two bodies.
        table_friction: Lateral friction of the table, the ground and the bases of all
            other fixed bodies that are not objects.
        finger_friction: Lateral friction of the robot's ``finger_links``.
        object_restitution: Restitution of all objects. If the nominal value is 0
            (Bullet's default), the drawn number replaces it instead of multiplying it.
            This range also gives the table and the other fixed bases a restitution of
            1, because Bullet multiplies the restitutions of the two bodies in contact.
        joint_damping: Damping of the robot's joints. Where the nominal value is 0, as
            in the Panda, the drawn number is the damping itself [N m s/rad].
        gravity: Gravity of the world.
        joint_position: Largest offset of the arm's joints from neutral at the start
            [rad].
        observe: Whether to observe ``physics_parameters``, float32 (*batch, k): the k
            drawn factors, in the order above.

    Raises:
        ValueError: A range is not (lowest, highest), finite and at least 0, and above 0
            for ``object_mass``; ``joint_position`` is negative; or ``observe`` is true
            without a range.
        TypeError: ``joint_position`` is not a number.
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
                check_range(field.name, value)
        if self.object_mass is not None and not min(self.object_mass) > 0:
            raise ValueError(f"object_mass must be above 0, got {self.object_mass}")
        check_not_negative(joint_position=self.joint_position)
        if self.observe and not self.names:
            raise ValueError(f"observe=True needs a range of one of {PARAMETERS}")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the drawn factors, in the order of ``physics_parameters``."""
        return tuple(name for name in PARAMETERS if getattr(self, name) is not None)


class _Target(NamedTuple):
    """The properties that a factor multiplies.

    Attributes:
        argument: Argument of `PhysicsClient.set_dynamics` that sets the property.
        links: The links that have it, as (body, link).
        nominal_value: Reads the nominal value of a link.
    """

    argument: str
    links: Sequence[tuple[int, int]]
    nominal_value: Callable[[int, int], float]


class PhysicsFactors:
    """Holds the nominal physics of a scene, and multiplies clients' physics by factors.

    Args:
        names: Names of the factors, from `PARAMETERS`.
        client: A client whose physics still have their nominal values.
        scene: The scene that all clients hold.
        finger_links: The robot's ``finger_links``.
    """

    def __init__(
        self,
        names: Sequence[str],
        client: PhysicsClient,
        scene: Scene,
        finger_links: Sequence[int],
    ) -> None:
        listed = {scene.robot, *scene.objects, *scene.markers}
        fixed = [
            (body, -1)
            for body in client.bodies
            if body not in listed and client.mass(body) == 0
        ]
        objects = [
            (body, link)
            for body in scene.objects
            for link in range(-1, len(client.joints(body)))  # -1 is the base
        ]
        fingers = [(scene.robot, link) for link in finger_links]
        joints = [(scene.robot, joint) for joint in scene.joints]
        damping = {joint.number: joint.damping for joint in client.joints(scene.robot)}
        targets = {
            "object_mass": _Target("mass", objects, client.mass),
            "object_friction": _Target("lateral_friction", objects, client.friction),
            "table_friction": _Target("lateral_friction", fixed, client.friction),
            "finger_friction": _Target("lateral_friction", fingers, client.friction),
            "object_restitution": _Target("restitution", objects, client.restitution),
            "joint_damping": _Target(
                "joint_damping", joints, lambda _, joint: damping[joint]
            ),
        }
        self._gravity: tuple[int, float] | None = None
        # By link: (argument of `set_dynamics`, index of the factor, nominal value).
        self._changes: dict[tuple[int, int], list[tuple[str, int, float]]] = {}
        for index, name in enumerate(names):
            if name == "gravity":
                self._gravity = (index, client.gravity)
                continue
            target = targets[name]
            # A nominal value of 0 is replaced by 1 if the drawn number should become
            # the value itself. Otherwise it stays 0, and the link is left out.
            zero_substitute = 1.0 if name in _ABSOLUTE_AT_ZERO else 0.0
            for body, link in target.links:
                if value := target.nominal_value(body, link) or zero_substitute:
                    change = (target.argument, index, value)
                    self._changes.setdefault((body, link), []).append(change)
            if name == "object_restitution":
                for base in fixed:
                    change = ("restitution", _CONSTANT, 1.0)
                    self._changes.setdefault(base, []).append(change)

    def apply(self, client: PhysicsClient, factors: Sequence[float]) -> None:
        """Set the physics of a client to the nominal values times k factors."""
        factors = (*factors, 1.0)
        for (body, link), changes in self._changes.items():
            values = {name: factors[index] * value for name, index, value in changes}
            client.set_dynamics(body, link, **values)
        if self._gravity is not None:
            index, value = self._gravity
            client.set_gravity(factors[index] * value)


class DomainRandomizer:
    """Draws the physics of n environments and changes their clients.

    Two sources vary the physics: a `Randomization`, and the hook `Task.randomize`.

    The drawn factors, and the seed for the hook, are part of the state of an
    environment. A reset to a state therefore restores the physics too.

    Attributes:
        state: Entries of the state that determine the physics of the present episodes,
            (n, ...) by key.
        entries: Observed entries, by key.
        changes_physics: Whether `apply` changes anything.
        is_active: Whether `sample` draws anything.
    """

    def __init__(
        self,
        randomization: Randomization | None,
        robot: Robot,
        task: Task,
        simulation: VectorSimulation,
    ) -> None:
        self._randomization = randomization or Randomization()
        self._task = task
        self._simulation = simulation
        self._num_arm_joints = robot.num_arm_joints
        self._bodies = Bodies(simulation.scene.objects, simulation.scene.markers)
        self._factors: PhysicsFactors | None = None
        self.state: dict[str, Tensor] = {}
        self.entries: dict[str, Entry] = {}
        n, names = simulation.num_envs, self._randomization.names
        if type(task).randomize is not Task.randomize:
            self.state[PHYSICS_SEED] = torch.zeros(
                n, 1, dtype=torch.int64, device="cpu"
            )
        if names:
            k = len(names)
            ranges = [getattr(self._randomization, name) for name in names]
            self._bounds = np.array(ranges).T  # lowest and highest factors, (2, k)
            self._is_mass = torch.tensor(
                [name == "object_mass" for name in names], device="cpu"
            )
            self._factors = PhysicsFactors(
                names,
                simulation.clients[0],
                simulation.scene,
                robot.finger_links,
            )
            self.state[PHYSICS_PARAMETERS] = torch.ones(
                n, k, dtype=torch.float64, device="cpu"
            )
            if self._randomization.observe:
                self.entries[PHYSICS_PARAMETERS] = Entry((k,), torch.float32)
        self.changes_physics = bool(self.state)
        self.is_active = self.changes_physics or self._randomization.joint_position > 0

    def sample(self, env: int, seed: np.random.SeedSequence) -> None:
        """Draw the physics and the joint offsets of an environment's next episode.

        Args:
            env: The environment. Its row of ``joint_position`` must already hold the
                neutral pose.
            seed: Seed of the physics of this episode.
        """
        if PHYSICS_SEED in self.state:
            number = int(seed.generate_state(1, np.uint64)[0])
            self.state[PHYSICS_SEED][env] = number >> 1  # fits into int64
        rng = np.random.default_rng(seed)
        if PHYSICS_PARAMETERS in self.state:
            factors = rng.uniform(*self._bounds)
            self.state[PHYSICS_PARAMETERS][env] = torch.from_numpy(factors)
        if limit := self._randomization.joint_position:
            arm = self._simulation.joint_position[env, : self._num_arm_joints]
            arm += torch.from_numpy(rng.uniform(-limit, limit, size=len(arm)))

    def apply(self, env: int) -> None:
        """Set the physics of an environment's client from the environment's state."""
        client = self._simulation.clients[env]
        if self._factors is not None:
            self._factors.apply(client, self.state[PHYSICS_PARAMETERS][env].tolist())
        if PHYSICS_SEED in self.state:
            rng = np.random.default_rng(int(self.state[PHYSICS_SEED][env]))
            self._task.randomize(client, self._bodies, rng)

    def observe(self) -> dict[str, Tensor]:
        """The observed entries of all environments, (n, ...), in new tensors."""
        return {key: self.state[key].float() for key in self.entries}

    def check_state(self, values: dict[str, Tensor], envs: Sequence[int]) -> None:
        """Check the factors (len(envs), k) in a state to start from.

        Raises:
            ValueError: A factor is negative, or the factor of a mass is 0: Bullet
                treats a body without mass as fixed.
        """
        if PHYSICS_PARAMETERS in values:
            factors = values[PHYSICS_PARAMETERS]
            is_valid = (factors > 0) | (factors == 0) & ~self._is_mass
            requirement = "at least 0, and above 0 for a mass"
            check_rows(PHYSICS_PARAMETERS, is_valid, envs, requirement)
