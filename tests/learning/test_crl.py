"""CRL learns online from achieved goals alone."""

import pytest
import torch
from torch.nn.functional import cross_entropy

import torch_panda
from tests.learning.transitions import make_transitions
from torch_panda.learning.agents import Hyperparameters, make_agent
from torch_panda.learning.agents.crl import (
    LOGSUMEXP_WEIGHT,
    contrastive_loss,
    distances,
)
from torch_panda.learning.options import Args
from torch_panda.learning.training import Run


@pytest.fixture(scope="module")
def env():
    with torch_panda.make("PandaPush-v1", num_envs=4) as env:
        yield env


def make(env, **options):
    torch.manual_seed(0)
    return make_agent(env, Hyperparameters(algo="crl", **options))


def test_the_contrastive_loss_is_a_symmetric_cross_entropy():
    logits = torch.randn(8, 8)
    labels = torch.arange(8)
    expected = cross_entropy(logits, labels) + cross_entropy(logits.T, labels)
    expected += LOGSUMEXP_WEIGHT * logits.exp().sum(1).log().square().mean()
    torch.testing.assert_close(contrastive_loss(logits), expected)


def test_small_distances_are_exact():
    x = torch.randn(64, 16)
    y = x + 1e-3
    expected = (x - y).norm(dim=-1)
    torch.testing.assert_close(distances(x, y).diagonal(), expected)


def test_crl_uses_no_rewards(env):
    batch = make_transitions(env, 64)
    other = batch.clone()
    other["next", "reward"] = torch.randn(64, 1)
    other["next", "terminated"] = ~batch["next", "terminated"]
    agents = make(env), make(env)
    for agent, rows in zip(agents, (batch, other), strict=True):
        agent.update(rows)
    first, second = (list(agent.parameters()) for agent in agents)
    assert all(map(torch.equal, first, second))


def test_the_actors_loss_does_not_train_the_critic(env):
    batch = make_transitions(env, 64)
    agents = [make(env, action_l2=weight) for weight in (0.0, 2.0)]
    for agent in agents:
        agent.update(batch.clone())
    for net in ("phi", "psi", "actor"):
        first, second = (list(getattr(a, net).parameters()) for a in agents)
        assert all(map(torch.equal, first, second)) == (net != "actor")


def test_large_actions_are_penalised(env):
    batch = make_transitions(env, 64)
    losses = [
        make(env, action_l2=weight).update(batch.clone())["actor_loss"]
        for weight in (0.0, 1.0, 2.0)
    ]
    assert losses[0] < losses[1]
    torch.testing.assert_close(losses[2] - losses[1], losses[1] - losses[0])


def test_learns_reach(tmp_path):
    """With the seeds 0 to 4, the success rises from 0 to between 86 and 100 %."""
    args = Args(algo="crl", her="geometric", num_envs=8, gamma=0.95, batch_size=128)
    args.relative_inputs, args.network = "coarse", "layer-norm"
    args.total_steps = args.eval_interval = 1_600
    run = Run(args, tmp_path)
    assert run.train()
    run.close()
    curve = run.progress.curve
    assert [row["success"] > 0.8 for row in (curve[0], curve[-1])] == [False, True]
