"""Push a box with arms that are not the Panda.

python -m torch_panda train --import examples/own_tasks/xarm_box.py --env-id XArmBox-v0
"""

from collections.abc import Sequence

import numpy as np
from torch import Tensor

import torch_panda
from torch_panda.bullet import Box, PhysicsClient, VectorSimulation
from torch_panda.robots import Kuka, XArm6
from torch_panda.tasks import Bodies, create_table, object_observation

HALF_EXTENTS = (0.03, 0.05, 0.03)  # [m]
CENTER = (0.0, 0.0, HALF_EXTENTS[2])


class PushBox(torch_panda.Task):
    """Push a box to a point of the table."""

    goal_dim, observation_dim = 3, 12

    def build(self, client: PhysicsClient) -> Bodies:
        """Build the table, the box, and a marker that shows the goal."""
        create_table(client)
        box = client.create_box(HALF_EXTENTS, mass=0.5, position=CENTER)
        marker = client.create_marker(CENTER, Box(HALF_EXTENTS))
        return Bodies(objects=(box,), markers=(marker,))

    def sample_goal(self, rng: np.random.Generator) -> Sequence[float]:
        """Draw a position of the box on the table [m]."""
        return (*rng.uniform(-0.12, 0.12, size=2), CENTER[2])

    def sample_objects(self, rng: np.random.Generator) -> Sequence[Sequence[float]]:
        """Draw the start of the box: position [m] and quaternion xyzw."""
        return ((*rng.uniform(-0.12, 0.12, size=2), CENTER[2], 0, 0, 0, 1),)

    def observation(self, simulation: VectorSimulation) -> Tensor:
        """The position, Euler angles and velocities of the box: (num_envs, 12)."""
        return object_observation(simulation, 0)

    def achieved_goal(self, simulation: VectorSimulation) -> Tensor:
        """The position of the box: (num_envs, 3)."""
        return simulation.object_position[:, 0]


torch_panda.register("XArmBox-v0", robot=XArm6, task=PushBox)
torch_panda.register("KukaBox-v0", robot=Kuka, task=PushBox)
