"""Multilayer perceptrons of actors, critics and value functions."""

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.func import functional_call
from torchrl.modules import MLP

from torch_panda.learning.agents.hyperparameters import Network

# Units of each hidden layer.
HIDDEN_SIZE = 256  # as in the panda-gym paper
WIDE_SIZE = 448  # keeps the file of a policy below 2 MB, so that it can be shipped


def make_mlp(inputs: int, outputs: int, network: Network) -> MLP:
    """Make a network with three hidden layers, which concatenates its arguments.

    Args:
        inputs: Number of inputs, over all arguments of the network.
        outputs: Number of outputs.
        network: Hidden layers; see `Hyperparameters.network`.
    """
    size = WIDE_SIZE if network == "wide" else HIDDEN_SIZE
    is_normalized = network != "paper"
    norm = {"normalized_shape": size}
    return MLP(
        in_features=inputs,
        out_features=outputs,
        num_cells=[size] * 3,
        activation_class=nn.GELU if network == "gelu" else nn.ReLU,
        norm_class=nn.LayerNorm if is_normalized else None,
        norm_kwargs=[norm] * 3 if is_normalized else None,
    )


class Ensemble(nn.ModuleList):
    """Value functions V(x) or Q(x) of the same inputs.

    Args:
        inputs: Number of inputs, over all arguments.
        network: Hidden layers; see `Hyperparameters.network`.
        number: Number of value functions.
    """

    def __init__(self, inputs: int, network: Network, number: int = 2) -> None:
        super().__init__(make_mlp(inputs, 1, network) for _ in range(number))

    def forward(self, *inputs: Tensor) -> Tensor:
        """The values, (number, n)."""
        return torch.stack([net(*inputs).squeeze(-1) for net in self])

    def target_value(self, *inputs: Tensor) -> Tensor:
        """The value from which all functions learn: the smallest one, (n,)."""
        return self(*inputs).amin(0)

    def policy_value(self, *inputs: Tensor) -> Tensor:
        """The value that a policy maximises: that of the first function, (n,)."""
        return self[0](*inputs).squeeze(-1)


class PartCritics(Ensemble):
    """A value function Q(s, a) for each part of the goal.

    Args:
        weights: Weights of the state's numbers for each part, (parts, state size).
        action_size: Size of an action.
        network: Hidden layers; see `Hyperparameters.network`.
    """

    weights: Tensor

    def __init__(self, weights: Tensor, action_size: int, network: Network) -> None:
        parts, state_size = weights.shape
        super().__init__(state_size + action_size, network, parts)
        self.register_buffer("weights", weights, persistent=False)

    def forward(self, *inputs: Tensor) -> Tensor:
        """The values of states and actions, (parts, n)."""
        state, action = inputs
        states = state * self.weights.unsqueeze(1)
        return torch.stack(
            [net(x, action).squeeze(-1) for net, x in zip(self, states, strict=True)]
        )

    def target_value(self, *inputs: Tensor) -> Tensor:
        """The value of each part, from which its function learns, (parts, n)."""
        return self(*inputs)

    def policy_value(self, *inputs: Tensor) -> Tensor:
        """The mean over the parts, (n,)."""
        return self(*inputs).mean(0)


def freeze(network: nn.Module) -> Callable[..., Tensor]:
    """Return the function of a network, through which a loss does not train it.

    torchrl's `hold_out_net` does the same, but not under `torch.vmap`.
    """
    constants = {name: p.detach() for name, p in network.named_parameters()}

    def compute(*inputs: Tensor) -> Tensor:
        return functional_call(network, constants, inputs)

    return compute
