"""Random transitions, made without physics."""

import torch
from tensordict import TensorDict


def make_transitions(env, number):
    """Random transitions with torchrl's keys and the sizes of an environment."""
    spec = env.observation_spec_unbatched

    def observation():
        keys = ("observation", "desired_goal")
        return {key: torch.randn(number, *spec[key].shape) for key in keys}

    first = observation()
    following = {**observation(), "desired_goal": first["desired_goal"]}
    following["terminated"] = following["done"] = torch.rand(number, 1) < 0.2
    following["reward"] = -(torch.rand(number, 1) < 0.7).float()
    action = torch.rand(number, *env.action_spec_unbatched.shape) * 2 - 1
    return TensorDict({**first, "action": action, "next": following}, [number])
