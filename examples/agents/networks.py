"""What agents are made of: actors and critics, and the noise by which they explore."""

import torch
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.modules import MLP, AdditiveGaussianModule, EGreedyModule

from agents.hyperparameters import Hyperparameters
from torch_panda import RobotTaskEnv

HIDDEN_SIZE = 256  # units of each of the three layers, as in the panda-gym paper


def make_mlp(inputs: int, outputs: int, *, layer_norm: bool) -> MLP:
    """Three hidden layers; several inputs, (..., n) each, are concatenated."""
    norm = {"normalized_shape": HIDDEN_SIZE}
    return MLP(
        in_features=inputs,
        out_features=outputs,
        num_cells=[HIDDEN_SIZE] * 3,
        activation_class=nn.ReLU,
        norm_class=nn.LayerNorm if layer_norm else None,
        norm_kwargs=[norm] * 3 if layer_norm else None,
    )


def make_noise(env: RobotTaskEnv, hp: Hyperparameters) -> list[TensorDictModuleBase]:
    """What changes the ``action`` of a deterministic actor to explore."""
    noise = AdditiveGaussianModule(
        env.action_spec, sigma_init=hp.noise_eps, sigma_end=hp.noise_eps
    )
    random_action = EGreedyModule(env.action_spec)
    # (num_envs,): compared with one random number per environment.
    random_action.eps = torch.linspace(*hp.random_eps, env.batch_size[0])
    return [noise, random_action]
