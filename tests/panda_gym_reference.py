"""panda-gym 3.0.7 as the reference, started where one of our environments starts."""

import gymnasium
import panda_gym.envs.panda_tasks
from panda_gym.pybullet import PyBullet


class _NoTextures(PyBullet):
    """panda-gym's wheel misses the texture of Flip's cube; physics does not need it."""

    def create_box(self, *args, texture=None, **kwargs):
        super().create_box(*args, **kwargs)


def make_reference(env_id):
    """A fresh panda-gym environment, without gymnasium's wrappers."""
    tasks = panda_gym.envs.panda_tasks
    tasks.PyBullet = _NoTextures
    try:
        return gymnasium.make(env_id).unwrapped
    finally:
        tasks.PyBullet = PyBullet


def start(reference, state):
    """Start an episode from the state (of batch size []) and return the observation."""
    reference.reset(seed=0)
    reference.task.goal = state["desired_goal"].numpy()
    bodies = reference.sim._bodies_idx
    names = [name for name in ("object", "object1", "object2") if name in bodies]
    for name, pose in zip(names, state["object_pose"].numpy(), strict=True):
        reference.sim.set_base_pose(name, pose[:3], pose[3:])
    return reference._get_obs()
