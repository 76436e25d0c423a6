"""Actions that make contacts."""

import torch


def pusher(env, noise=0.0):
    """A policy that moves the hand to the object and pushes it, with Gaussian noise."""
    generator = torch.Generator().manual_seed(0)

    def push(td):
        action = noise * torch.randn(env.action_spec.shape, generator=generator)
        action[..., :3] += 20 * (td["achieved_goal"] - td["observation"][..., :3])
        return td.set("action", action)

    return push
