"""Helpers: record a small data set, and imitate one."""

from pathlib import Path

import torch

from torch_panda.commands import record as record_demos
from torch_panda.learning.agents import Hyperparameters, make_agent
from torch_panda.learning.evaluation import evaluate_episodes
from torch_panda.learning.pretraining import make_demo_buffer


def record(format, out, env_id, episodes, seed=0, **options):
    record_demos.main(
        record_demos.Args(
            env_id, episodes, seed, num_envs=8, format=format, out=Path(out), **options
        )
    )


def imitate(env, demos):
    """The success rate of an agent after 600 gradient steps of imitation."""
    torch.manual_seed(0)
    agent = make_agent(env, Hyperparameters())
    agent.normalizer.update(demos["observation"], demos["desired_goal"])
    buffer = make_demo_buffer(demos)
    untrained = evaluate_episodes(env, agent.policy, 16).success_rate
    assert untrained < 0.5
    for _ in range(600):
        agent.imitate(buffer.sample(128))
    return evaluate_episodes(env, agent.policy, 16).success_rate
