"""What actors and critics are made of."""

from torch import nn
from torchrl.modules import MLP

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
