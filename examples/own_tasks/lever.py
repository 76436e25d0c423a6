"""Turn a lever until its knob is at a point.

python -m torch_panda train --import examples/own_tasks/lever.py --env-id Lever-v0
"""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import torch_panda
from torch_panda.bullet import Box, PhysicsClient, VectorSimulation
from torch_panda.tasks import Bodies, Start, create_table

URDF = Path(__file__).with_name("lever.urdf")
HINGE = 0  # index of the joint
AXIS, LENGTH, HEIGHT = (0.1, 0.0), 0.2, 0.04  # of the lever [m]
LARGEST_ANGLE = 1.0  # of starts and goals [rad]


class Lever(torch_panda.Task):
    """Turn a lever about a vertical axis."""

    goal_dim, observation_dim = 3, 5

    def build(self, client: PhysicsClient) -> Bodies:
        """Build the table, the lever, and a marker that shows the goal."""
        create_table(client)
        lever = client.load_urdf(URDF, position=(*AXIS, 0.0), fixed_base=True)
        client.set_joint_friction(lever, HINGE, 0.5)  # [N m]
        marker = client.create_marker((-0.1, 0.0, HEIGHT), Box((0.015, 0.015, 0.03)))
        return Bodies(objects=(lever,), markers=(marker,))

    def sample_start(self, rng: np.random.Generator) -> Start:
        """Draw the angles at the start and at the goal, at least 0.4 rad apart."""
        start, goal = rng.uniform(-LARGEST_ANGLE, LARGEST_ANGLE, size=2)
        while abs(goal - start) < 0.4:
            start, goal = rng.uniform(-LARGEST_ANGLE, LARGEST_ANGLE, size=2)
        knob = AXIS - LENGTH * np.array((np.cos(goal), np.sin(goal)))
        return Start((*knob, HEIGHT), ((*AXIS, 0.0, 0, 0, 0, 1),), (start,))

    def observation(self, simulation: VectorSimulation) -> Tensor:
        """The knob's position, and the lever's angle and velocity: (num_envs, 5)."""
        hinge = simulation.object_joint_position, simulation.object_joint_velocity
        return torch.cat((self.achieved_goal(simulation), *hinge), dim=1)

    def achieved_goal(self, simulation: VectorSimulation) -> Tensor:
        """The knob's position: (num_envs, 3)."""
        angle = simulation.object_joint_position
        x, y = AXIS[0] - LENGTH * angle.cos(), AXIS[1] - LENGTH * angle.sin()
        return torch.cat((x, y, torch.full_like(angle, HEIGHT)), dim=1)


def make_robot() -> torch_panda.Robot:
    """A Panda whose fingers stay closed."""
    return torch_panda.Panda(block_gripper=True)


torch_panda.register("Lever-v0", robot=make_robot, task=Lever)
