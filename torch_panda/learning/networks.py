"""Networks of actors and critics."""

from torch import nn
from torchrl.modules import MLP

from torch_panda.learning.hyperparameters import Network

# Units of each of the three hidden layers: the panda-gym paper's number, and the most
# for which a policy's file stays below 2 MB.
HIDDEN_SIZE, WIDE_SIZE = 256, 448


def make_mlp(inputs: int, outputs: int, network: Network) -> MLP:
    """Make a network with three hidden layers that concatenates its inputs."""
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
