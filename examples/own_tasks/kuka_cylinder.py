"""Push a cylinder with an arm that is not the Panda.

python -m torch_panda train --import examples/own_tasks/kuka_cylinder.py \
        --env-id KukaCylinder-v0
"""

from collections.abc import Sequence

import numpy as np
from torch import Tensor

import torch_panda
from torch_panda.bullet import Cylinder, PhysicsClient, VectorSimulation
from torch_panda.tasks import Bodies, create_table, object_observation

RADIUS, HEIGHT = 0.03, 0.05  # [m]
CENTER = (0.0, 0.0, HEIGHT / 2)


class PushCylinder(torch_panda.Task):
    """Push a cylinder to a point of the table."""

    goal_dim, observation_dim = 3, 12

    def build(self, client: PhysicsClient) -> Bodies:
        """Build the table, the cylinder, and a marker that shows the goal."""
        create_table(client)
        cylinder = client.create_cylinder(RADIUS, HEIGHT, mass=0.5, position=CENTER)
        marker = client.create_marker(CENTER, Cylinder(RADIUS, HEIGHT))
        return Bodies(objects=(cylinder,), markers=(marker,))

    def sample_goal(self, rng: np.random.Generator) -> Sequence[float]:
        """Draw a position of the cylinder on the table [m]."""
        return (*rng.uniform(-0.12, 0.12, size=2), HEIGHT / 2)

    def sample_objects(self, rng: np.random.Generator) -> Sequence[Sequence[float]]:
        """Draw the cylinder's start: position [m] and quaternion xyzw."""
        return ((*rng.uniform(-0.12, 0.12, size=2), HEIGHT / 2, 0, 0, 0, 1),)

    def observation(self, simulation: VectorSimulation) -> Tensor:
        """The cylinder's position, Euler angles and velocities: (num_envs, 12)."""
        return object_observation(simulation, 0)

    def achieved_goal(self, simulation: VectorSimulation) -> Tensor:
        """The cylinder's position: (num_envs, 3)."""
        return simulation.object_pose[:, 0, :3]


def make_robot() -> torch_panda.Robot:
    """A KUKA iiwa that starts with its flange 15 cm above the table.

    The shipped `Kuka` starts 46 cm above it, and needs 15 of the 50 steps to come down.
    """
    return torch_panda.Robot(
        urdf="kuka_iiwa/model.urdf",
        neutral_joint_position=(0.0, 1.08, 0.0, -1.45, 0.0, 0.61, 0.0),
        effort_limits=(320, 320, 176, 176, 110, 40, 40),
        ee_link=6,
        ee_orientation=(0.0, 1.0, 0.0, 0.0),
        base_position=(-0.6, 0.0, 0.0),
    )


torch_panda.register("KukaCylinder-v0", robot=make_robot, task=PushCylinder)
