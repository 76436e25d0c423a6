"""What actors and critics are made of."""

from torch import nn
from torchrl.modules import MLP

from torch_panda.learning.hyperparameters import Network

# Units of each of the three hidden layers: as in the panda-gym paper, and as many as a
# file of 2 MB holds.
HIDDEN_SIZE, WIDE_SIZE = 256, 448


def make_mlp(inputs: int, outputs: int, network: Network) -> MLP:
    """Three hidden layers; several inputs, (..., n) each, are concatenated."""
    size = WIDE_SIZE if network == "wide" else HIDDEN_SIZE
    is_normalized = network != "paper"
    norm = {"normalized_shape": size}
    return MLP(
        in_features=inputs,
        out_features=outputs,
        num_cells=[size] * 3,
        activation_class=nn.ReLU,
        norm_class=nn.LayerNorm if is_normalized else None,
        norm_kwargs=[norm] * 3 if is_normalized else None,
    )
