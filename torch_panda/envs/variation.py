"""Physics that differ from episode to episode."""

import numpy as np
import torch
from torch import Tensor

from torch_panda.bullet import VectorSimulation
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
        task: the task.
        simulation: the environments.
        randomizes: whether there is a `Task.randomize`.

    Attributes:
        state: by key, (n, ...): what the physics of the present episodes depend on.
        entries: what is observed of it.
    """

    def __init__(
        self, task: Task, simulation: VectorSimulation, *, randomizes: bool
    ) -> None:
        self._task = task
        self._simulation = simulation
        scene = simulation.scene
        self._bodies = Bodies(scene.objects, scene.markers)
        self.state: dict[str, Tensor] = {}
        self.entries: dict[str, Entry] = {}
        self._seed: Tensor | None = None
        if randomizes:
            n = simulation.num_envs
            self._seed = torch.zeros(n, 1, dtype=torch.int64, device="cpu")
            self.state[PHYSICS_SEED] = self._seed

    def draw(self, env: int, seed: int) -> None:
        """Draw the physics of an environment's next episode."""
        if self._seed is not None:
            self._seed[env] = seed

    def apply(self, env: int) -> None:
        """Give an environment the physics of its state."""
        client = self._simulation.clients[env]
        if self._seed is not None:
            rng = np.random.default_rng((int(self._seed[env]), 1))
            self._task.randomize(client, self._bodies, rng)

    def observe(self) -> dict[str, Tensor]:
        """What is observed, (n, ...), in new tensors."""
        return {}
