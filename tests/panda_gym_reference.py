"""panda-gym 3.0.7 as the reference, started where one of our environments starts."""

import gymnasium
import numpy as np
import panda_gym.envs.panda_tasks
from panda_gym.pybullet import PyBullet


class _NoTextures(PyBullet):
    """panda-gym's wheel misses the texture of Flip's cube; physics does not need it."""

    def create_box(self, *args, texture=None, **kwargs):
        super().create_box(*args, **kwargs)


def make_reference(env_id, **options):
    """A fresh panda-gym environment, without gymnasium's wrappers."""
    tasks = panda_gym.envs.panda_tasks
    tasks.PyBullet = _NoTextures
    try:
        return gymnasium.make(env_id, **options).unwrapped
    finally:
        tasks.PyBullet = PyBullet


def start(reference, seed):
    """Start an episode; return its observation, object poses and goal."""
    observation, _ = reference.reset(seed=seed)
    sim = reference.sim
    names = [n for n in ("object", "object1", "object2") if n in sim._bodies_idx]
    poses = [
        (*sim.get_base_position(name), *sim.get_base_orientation(name))
        for name in names
    ]
    return observation, np.reshape(poses, (len(names), 7)), reference.task.get_goal()
