"""Whole trainings on Reach: run with pytest -m slow."""

import math

import pytest
import torch

import torch_panda
from torch_panda import datasets
from torch_panda.learning.agents import make_agent
from torch_panda.learning.buffers import STORED_KEYS
from torch_panda.learning.evaluation import evaluate_episodes
from torch_panda.learning.offline_data import OfflineData
from torch_panda.learning.options import Args, default_args
from torch_panda.learning.training import Run

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def env():
    with torch_panda.make("PandaReach-v1", num_envs=20, seed=0) as env:
        yield env


@pytest.fixture(scope="module")
def transitions():
    """Noisy demonstrations of Reach, (4000,)."""
    data = datasets.generate(
        "PandaReach-v1", kind="noisy", transitions=4_000, seed=0, num_envs=20
    )
    return data.select(*STORED_KEYS).reshape(-1)


@pytest.mark.parametrize(
    "algo", ["gcbc", "gcivl", "gciql", "gciql-nstep", "hiql", "qrl"]
)
def test_offline_agents_learn_to_reach(env, transitions, algo):
    torch.manual_seed(0)
    agent = make_agent(env, default_args("offline", "PandaReach-v1", algo))
    data = OfflineData(transitions.clone(), env, agent.goal_strategies, agent.gamma)
    batch = agent.extend(data.sample(2_000), data)
    agent.normalizer.update(batch["observation"], batch["actor_goal"])
    env.set_seed(1)
    untrained = evaluate_episodes(env, agent.policy, 20)
    for _ in range(400):
        losses = agent.update(agent.extend(data.sample(128), data))
    assert all(math.isfinite(loss) for loss in losses.values())
    assert agent.updates == 400
    env.set_seed(1)
    trained = evaluate_episodes(env, agent.policy, 20)
    assert untrained.success_rate < 0.5
    assert trained.success_rate > 0.8


def test_crl_learns_to_reach_from_achieved_goals_alone(tmp_path):
    """With the seeds 0 to 4, the success rises from 0 to between 86 and 100 %."""
    args = Args(algo="crl", her="geometric", num_envs=8, gamma=0.95, batch_size=128)
    args.relative_inputs, args.network = "coarse", "layer-norm"
    args.total_steps = args.eval_interval = 1_600
    run = Run(args, tmp_path)
    assert run.train()
    run.close()
    curve = run.progress.curve
    assert [row["success"] > 0.8 for row in (curve[0], curve[-1])] == [False, True]
