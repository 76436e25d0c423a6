"""Helpers of the tests that train."""

import csv

# A file of a user, which registers an id.
MODULE = """
import torch_panda
from torch_panda import Panda, Reach

torch_panda.register(
    "Near-v0",
    robot=lambda: Panda(block_gripper=True),
    task=lambda: Reach(goal_range=0.1),
    max_episode_steps=10,
)
"""


class After:
    """A stop signal that becomes true when it is asked for the n-th time."""

    def __init__(self, number):
        self.left = number

    def __bool__(self):
        self.left -= 1
        return self.left < 0


def read_curve(folder):
    """The rows of a run's curve.csv."""
    with (folder / "curve.csv").open() as file:
        return list(csv.DictReader(file))


def weights(run):
    """A copy of the weights of a run's agent."""
    return {key: x.clone() for key, x in run.agent.state_dict().items()}


def points(run):
    """The curve of a run, without the time that it took."""
    return [{**row, "seconds": 0} for row in run.progress.curve]


class Kill(BaseException):
    """Ends a run as a kill of its process does."""


def kill(*arguments, **options):
    raise Kill
