"""Physics that differ from episode to episode."""

import numpy as np
import torch
from torch import Tensor

from torch_panda.bullet import PhysicsParams, VectorSimulation
from torch_panda.randomization import PhysicsFactors, Randomization
from torch_panda.robots import Robot
from torch_panda.sensors import Entry
from torch_panda.tasks import Bodies, Task

# Entries of a state on which the physics of an episode depend.
PHYSICS_SEED = "physics_seed"
PHYSICS_PARAMETERS = "physics_parameters"
PHYSICS = (PHYSICS_SEED, PHYSICS_PARAMETERS)


class Variation:
    """Changes the physics of environments before their episodes.

    What an episode's physics depend on is part of the state, so that they come back
    with it.

    Args:
        randomization: what is drawn; None: nothing.
        robot: the robot.
        task: the task.
        simulation: the environments.
        physics: how they integrate.
        has_hook: whether there is a `Task.randomize`.

    Attributes:
        state: by key, (n, ...): what the physics of the present episodes depend on.
        entries: what is observed of it.
        is_mass: (k,) bool, which of the ``physics_parameters`` are of masses.
    """

    def __init__(
        self,
        randomization: Randomization | None,
        robot: Robot,
        task: Task,
        simulation: VectorSimulation,
        physics: PhysicsParams,
        *,
        has_hook: bool,
    ) -> None:
        self._randomization = randomization or Randomization()
        self._task = task
        self._simulation = simulation
        self._num_arm_joints = robot.num_arm_joints
        n, scene = simulation.num_envs, simulation.scene
        names = self._randomization.names
        self._bodies = Bodies(scene.objects, scene.markers)
        self._factors: PhysicsFactors | None = None
        is_mass = [name == "object_mass" for name in names]
        self.is_mass = torch.tensor(is_mass, dtype=torch.bool, device="cpu")
        self.state: dict[str, Tensor] = {}
        self.entries: dict[str, Entry] = {}
        if has_hook:
            seed = torch.zeros(n, 1, dtype=torch.int64, device="cpu")
            self.state[PHYSICS_SEED] = seed
        if names:
            k, double = len(names), torch.float64
            self._bounds = self._randomization.bounds()
            self._factors = PhysicsFactors(
                names, simulation.clients[0], scene, robot.finger_links, physics
            )
            self.state[PHYSICS_PARAMETERS] = torch.ones(
                n, k, dtype=double, device="cpu"
            )
            if self._randomization.observe:
                self.entries[PHYSICS_PARAMETERS] = Entry((k,), torch.float32)
        self.changes_physics = bool(self.state)
        self.is_on = self.changes_physics or self._randomization.joint_position > 0

    def draw(self, env: int, seed: np.random.SeedSequence) -> None:
        """Draw an environment's next episode, when the rest of its start is drawn."""
        if PHYSICS_SEED in self.state:
            number = int(seed.generate_state(1, np.uint64)[0])
            self.state[PHYSICS_SEED][env] = number >> 1  # fits into int64
        rng = np.random.default_rng(seed)
        if PHYSICS_PARAMETERS in self.state:
            drawn = rng.uniform(*self._bounds)
            self.state[PHYSICS_PARAMETERS][env] = torch.from_numpy(drawn)
        if most := self._randomization.joint_position:
            arm = self._simulation.joint_position[env, : self._num_arm_joints]
            arm += torch.from_numpy(rng.uniform(-most, most, size=len(arm)))

    def apply(self, env: int) -> None:
        """Give an environment the physics of its state."""
        client = self._simulation.clients[env]
        if self._factors is not None:
            factors = self.state[PHYSICS_PARAMETERS][env].tolist()
            self._factors.apply(client, factors)
        if PHYSICS_SEED in self.state:
            seed = int(self.state[PHYSICS_SEED][env])
            rng = np.random.default_rng(seed)
            self._task.randomize(client, self._bodies, rng)

    def observe(self) -> dict[str, Tensor]:
        """What is observed, (n, ...), in new tensors."""
        if not self.entries:
            return {}
        return {PHYSICS_PARAMETERS: self.state[PHYSICS_PARAMETERS].float()}
