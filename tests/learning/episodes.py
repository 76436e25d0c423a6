"""Random episodes, as a collector gives them."""

import torch
from torchrl.envs.utils import RandomPolicy


def play(env):
    """One of every environment of -v1, [num_envs, steps]."""
    torch.manual_seed(0)
    policy = RandomPolicy(env.action_spec)
    data = env.rollout(env.max_episode_steps, policy, break_when_any_done=False)
    ids = torch.arange(len(data))[:, None].expand(data.shape)
    return data.set(("collector", "traj_ids"), ids)
