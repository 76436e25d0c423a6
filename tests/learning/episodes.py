"""Random episodes, in the form of a collector's batches."""

import torch
from torchrl.envs.utils import RandomPolicy


def play_randomly(env):
    """One random episode of every environment of an id -v1, [num_envs, steps]."""
    torch.manual_seed(0)
    policy = RandomPolicy(env.action_spec)
    data = env.rollout(env.max_episode_steps, policy, break_when_any_done=False)
    ids = torch.arange(len(data))[:, None].expand(data.shape)
    return data.set(("collector", "traj_ids"), ids)
