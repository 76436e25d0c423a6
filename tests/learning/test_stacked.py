"""Agents that take their gradient steps together learn as each would alone."""

import pytest
import torch

from tests.learning.episodes import play
from torch_panda.learning.agents import OFFLINE_AGENTS, make_agent, networks
from torch_panda.learning.agents.stacked import StackedAgents
from torch_panda.learning.offline_data import OfflineData
from torch_panda.learning.options import default_args

SEEDS, STEPS = 3, 20


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    monkeypatch.setattr(networks, "HIDDEN_SIZE", 32)


def make_learner(algo, seed):
    """An agent, and batches for it."""
    env, data = play("PandaPush-v1")
    torch.manual_seed(seed)
    agent = make_agent(env, default_args("offline", "PandaPush-v1", algo))
    # So that the statistics of the agents differ.
    part = data[torch.randperm(len(data))[:100]]
    agent.normalizer.update(part["observation"], part["desired_goal"])
    rows = OfflineData(data, env, agent.goal_strategies, agent.gamma)
    return agent, [agent.extend(rows.sample(16), rows) for _ in range(STEPS)]


def make_learners(algo):
    agents, batches = zip(*(make_learner(algo, i) for i in range(SEEDS)), strict=True)
    return agents, [*zip(*batches, strict=True)]


def states(agents):
    """Weights, statistics and the optimizer's state of each agent."""
    return [(a.state_dict(), a.optimizer.state_dict()["state"]) for a in agents]


@pytest.mark.parametrize("algo", OFFLINE_AGENTS)
def test_agents_learn_together_as_alone(algo):
    agents, batches = make_learners(algo)
    expected = [
        [agent.update(batch) for agent, batch in zip(agents, rows, strict=True)]
        for rows in batches
    ]
    others, _ = make_learners(algo)
    stacked = StackedAgents(others)
    losses = [stacked.update(rows) for rows in batches]
    stacked.write_back()

    close = {"rtol": 1e-3, "atol": 1e-5}
    torch.testing.assert_close(losses, expected, **close)
    assert [agent.updates for agent in others] == [STEPS] * SEEDS
    torch.testing.assert_close(states(others), states(agents), **close)
    first, second = losses[0][:2]
    assert all(first[key] != second[key] for key in first if key != "multiplier_loss")
