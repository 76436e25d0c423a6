"""Multilayer perceptrons of actors and critics."""

from torch import nn
from torchrl.modules import MLP

from torch_panda.learning.hyperparameters import Network

# Units of each hidden layer.
HIDDEN_SIZE = 256  # as in the panda-gym paper
WIDE_SIZE = 448  # keeps the file of a policy below 2 MB, so that it can be shipped


def make_mlp(inputs: int, outputs: int, network: Network) -> MLP:
    """Make a network with three hidden layers, which concatenates its arguments.

    Args:
        inputs: Number of inputs, over all arguments of the network.
        outputs: Number of outputs.
        network: Size of the hidden layers, and whether they have LayerNorm; see
            `Hyperparameters.network`.
    """
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
