"""Gradient steps of several agents as one, for trainings with several seeds at once.

The networks are small, so that an agent uses a small part of a GPU. Here each weight of
n agents is a row of one tensor, and an operation of the step handles all n rows.
"""

import copy
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase, stack
from torch import Tensor
from torch.func import functional_call

from torch_panda.learning.agents.base import Agent


class StackedAgents:
    """Agents that take their gradient steps together.

    Each agent learns from its own batches. Apart from rounding, a step gives an agent
    the weights that it would have after a step alone. The steps change the stacked
    weights. Call `write_back` before an agent is used or saved.

    Args:
        agents: Agents of the same class with the same hyperparameters, which have taken
            the same number of gradient steps. Their losses draw no random numbers.
    """

    def __init__(self, agents: Sequence[Agent]) -> None:
        self.agents = agents
        # All its tensors get one more dimension in front, but for the optimizer's
        # number of steps. Its own step then trains all agents.
        self.stacked = copy.deepcopy(agents[0])
        self.stacked.forward = self._losses  # type: ignore[method-assign,assignment]
        self._rows = [_tensors(agent) for agent in agents]
        self._stacks = _tensors(self.stacked)
        for name, stacked in self._stacks.items():
            stacked.data = torch.stack([rows[name].data for rows in self._rows])
        states = [agent.optimizer.state_dict() for agent in agents]
        self.stacked.optimizer.load_state_dict(_stack_states(states))

    def update(self, batches: Sequence[TensorDictBase]) -> list[dict[str, Tensor]]:
        """Take one gradient step of each agent.

        Args:
            batches: The batch of each agent, of the same size.

        Returns:
            The losses of each agent by name, scalars without gradients.
        """
        losses = self.stacked.update(stack([*batches]))
        for agent in self.agents:
            agent.updates = self.stacked.updates
        return [
            {name: loss[i] for name, loss in losses.items()}
            for i in range(len(self.agents))
        ]

    def write_back(self) -> None:
        """Copy weights and the optimizer's state to the agents."""
        state = self.stacked.optimizer.state_dict()
        for i, (agent, rows) in enumerate(zip(self.agents, self._rows, strict=True)):
            for name, stacked in self._stacks.items():
                rows[name].data.copy_(stacked[i])
            agent.optimizer.load_state_dict(_take_row(state, i))

    def _losses(self, batches: TensorDictBase, _: None) -> dict[str, Tensor]:
        """The losses of all agents, (n,) each, on batches (n, batch size)."""

        def losses_of_one(
            tensors: dict[str, Tensor], batch: TensorDictBase
        ) -> dict[str, Tensor]:
            # Names that share a weight share its module, too.
            return functional_call(self.agents[0], tensors, (batch,), tie_weights=False)

        return torch.vmap(losses_of_one)(self._stacks, batches)


def _tensors(agent: Agent) -> dict[str, Tensor]:
    """Weights and statistics of an agent, by name."""
    named = dict(agent.named_parameters()) | dict(agent.named_buffers())
    saved = agent.state_dict().keys()
    return {name: tensor for name, tensor in named.items() if name in saved}


def _stack_states(states: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Stack the states of optimizers that have taken the same number of steps."""
    first = states[0]
    moments = {
        parameter: {
            key: value
            if key == "step"
            else torch.stack([state["state"][parameter][key] for state in states])
            for key, value in entries.items()
        }
        for parameter, entries in first["state"].items()
    }
    return {**first, "state": moments}


def _take_row(state: dict[str, Any], row: int) -> dict[str, Any]:
    """Copy the state of one optimizer from the stacked state."""
    moments = {
        parameter: {
            key: (value if key == "step" else value[row]).clone()
            for key, value in entries.items()
        }
        for parameter, entries in state["state"].items()
    }
    return {**state, "state": moments}
