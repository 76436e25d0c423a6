"""Push a ball that rolls on until it comes to rest by itself.

python -m torch_panda train --import examples/own_tasks/ball.py --env-id Ball-v0
"""

from collections.abc import Sequence

import numpy as np
from torch import Tensor

import torch_panda
from torch_panda.bullet import PhysicsClient, Sphere, VectorSimulation
from torch_panda.tasks import Bodies, create_table, object_observation

RADIUS = 0.03  # [m]


class Ball(torch_panda.Task):
    """Push a ball to a point of the table."""

    goal_dim, observation_dim = 3, 12

    def build(self, client: PhysicsClient) -> Bodies:
        """Build the table, the ball, and a marker that shows the goal."""
        create_table(client)
        center = (0.0, 0.0, RADIUS)
        ball = client.create_sphere(RADIUS, mass=0.5, position=center)
        # Without rolling friction the ball would never come to rest at its goal.
        client.set_friction(ball, lateral=0.5, rolling=0.01, spinning=0.01)
        marker = client.create_marker(center, Sphere(RADIUS))
        return Bodies(objects=(ball,), markers=(marker,))

    def sample_goal(self, rng: np.random.Generator) -> Sequence[float]:
        """Draw a position of the ball on the table [m]."""
        return (*rng.uniform(-0.15, 0.15, size=2), RADIUS)

    def sample_objects(self, rng: np.random.Generator) -> Sequence[Sequence[float]]:
        """Draw the ball's start: position [m] and quaternion xyzw."""
        return ((*rng.uniform(-0.12, 0.12, size=2), RADIUS, 0, 0, 0, 1),)

    def observation(self, simulation: VectorSimulation) -> Tensor:
        """The ball's position, Euler angles and velocities: (num_envs, 12)."""
        return object_observation(simulation, 0)

    def achieved_goal(self, simulation: VectorSimulation) -> Tensor:
        """The ball's position: (num_envs, 3)."""
        return simulation.object_pose[:, 0, :3]


def make_robot() -> torch_panda.Robot:
    """A Panda whose fingers stay closed."""
    return torch_panda.Panda(block_gripper=True)


torch_panda.register("Ball-v0", robot=make_robot, task=Ball)
