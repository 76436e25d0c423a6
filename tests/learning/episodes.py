"""Random episodes, in the form of a collector's batches."""

import functools

import torch
from torchrl.envs.utils import RandomPolicy

import torch_panda
from torch_panda.learning.buffers import STORED_KEYS


@functools.cache
def play(env_id):
    """Four environments, and the transitions of a random episode of each."""
    env = torch_panda.make(env_id, num_envs=4, seed=0)
    return env, play_randomly(env).select(*STORED_KEYS).reshape(-1)


def play_randomly(env):
    """One random episode of every environment of an id -v1, [num_envs, steps]."""
    torch.manual_seed(0)
    policy = RandomPolicy(env.action_spec)
    data = env.rollout(env.max_episode_steps, policy, break_when_any_done=False)
    ids = torch.arange(len(data))[:, None].expand(data.shape)
    return data.set(("collector", "traj_ids"), ids)
