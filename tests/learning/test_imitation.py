"""Imitation of demonstrations before reinforcement learning."""

from types import SimpleNamespace

import pytest
import torch

import torch_panda
from tests.learning.transitions import make_transitions
from torch_panda.learning.agents import Hyperparameters, make_agent
from torch_panda.learning.checkpoint import Progress
from torch_panda.learning.pretraining import pretrain


def test_the_learning_rate_of_imitation_falls_to_0(monkeypatch):
    """Reinforcement learning then starts with the usual learning rate."""
    with torch_panda.make("PandaPush-v1", num_envs=2) as env:
        agent = make_agent(env, Hyperparameters())
        rows = make_transitions(env, 8)
    rates, imitate = [], agent.imitate

    def remember(batch):
        rates.append(agent.optimizer.param_groups[0]["lr"])
        return imitate(batch)

    monkeypatch.setattr(agent, "imitate", remember)
    demos = SimpleNamespace(sample=lambda size: rows[torch.randint(8, (size,))])
    run = SimpleNamespace(agent=agent, progress=Progress(), save=lambda: None)
    pretrain(run, demos, updates=4, batch_size=2, learning_rate=0.5, stop=False)
    assert rates == pytest.approx([5e-4, 3.75e-4, 2.5e-4, 1.25e-4])
    assert agent.optimizer.param_groups[0]["lr"] == 1e-3
    assert run.progress.pretrained == 4
