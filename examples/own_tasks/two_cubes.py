"""Push two cubes, each to a goal of its own.

python -m torch_panda train --import examples/own_tasks/two_cubes.py \
        --env-id TwoCubes-v0

The class declares what its observations and goals contain, so data are also mirrored
and shifted over the table.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

import torch_panda
from torch_panda.bullet import Box, PhysicsClient, VectorSimulation
from torch_panda.tasks import (
    OBJECT_LAYOUT,
    Bodies,
    GoalEntries,
    create_table,
    object_observation,
)

HALF = 0.02  # half of a cube's edge [m]


class TwoCubes(torch_panda.Task):
    """Push two cubes to two points of the table."""

    goal_dim, observation_dim = 6, 24
    max_episode_steps = 80
    observation_layout = OBJECT_LAYOUT * 2
    # The goals are the positions in the observation: its numbers 0 to 2 and 12 to 14.
    goal_entries = GoalEntries("task", (0, 1, 2, 12, 13, 14))

    def build(self, client: PhysicsClient) -> Bodies:
        """Build the table, the cubes, and the markers that show the goals."""
        create_table(client)
        cubes, markers = [], []
        for k in (0, 1):
            position = (0.1 * k, 0.0, HALF)
            cubes.append(client.create_box((HALF,) * 3, mass=1.0, position=position))
            markers.append(client.create_marker(position, Box((HALF,) * 3)))
        return Bodies(objects=tuple(cubes), markers=tuple(markers))

    def sample_goal(self, rng: np.random.Generator) -> Sequence[float]:
        """Draw two positions that are apart from each other [m]."""
        first, second = sample_points(rng)
        return (*first, HALF, *second, HALF)

    def sample_objects(self, rng: np.random.Generator) -> Sequence[Sequence[float]]:
        """Draw the starts of the cubes: positions [m] and quaternions xyzw."""
        return [(*point, HALF, 0, 0, 0, 1) for point in sample_points(rng)]

    def observation(self, simulation: VectorSimulation) -> Tensor:
        """Positions, Euler angles and velocities of the cubes: (num_envs, 24)."""
        return torch.cat([object_observation(simulation, k) for k in (0, 1)], dim=1)

    def achieved_goal(self, simulation: VectorSimulation) -> Tensor:
        """Positions of the cubes: (num_envs, 6)."""
        return simulation.object_pose[:, :, :3].flatten(1)

    def distance(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """The distance of the cube that is farther from its goal: (..., 1)."""
        offsets = (achieved_goal - desired_goal).unflatten(-1, (2, 3))
        return offsets.norm(dim=-1).amax(dim=-1, keepdim=True)


def sample_points(rng: np.random.Generator) -> np.ndarray:
    """Draw two points of the table, at least 8 cm apart: (2, 2) [m]."""
    while True:
        points = rng.uniform(-0.14, 0.14, size=(2, 2))
        if np.linalg.norm(points[0] - points[1]) > 0.08:
            return points


def make_robot() -> torch_panda.Robot:
    """A Panda whose fingers stay closed."""
    return torch_panda.Panda(block_gripper=True)


torch_panda.register("TwoCubes-v0", robot=make_robot, task=TwoCubes)
