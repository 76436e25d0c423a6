"""Learning from demonstrations beside one's own transitions."""

import pytest
import torch

import torch_panda
from tests.learning.test_agents import critics_of
from tests.learning.transitions import make_transitions
from torch_panda.learning.agents import AGENTS, Hyperparameters, make_agent
from torch_panda.learning.agents.ddpg import BC_WEIGHT


@pytest.fixture(scope="module")
def env():
    with torch_panda.make("PandaPush-v1", num_envs=2) as env:
        yield env


@pytest.mark.parametrize("algo", ["ddpg", "td3"])
def test_an_agent_imitates_the_actions_that_its_critic_prefers(env, algo):
    def make():
        torch.manual_seed(0)
        return make_agent(env, Hyperparameters(algo=algo))

    batch, demos = make_transitions(env, 64), make_transitions(env, 32)
    agent = make()
    with torch.no_grad():
        state = agent.normalizer(demos["observation"], demos["desired_goal"])
        action = agent.actor(state)
        critic = agent.critics[0]
        better = critic(state, demos["action"]) > critic(state, action)
    assert 0 < better.sum() < len(better)
    expected = BC_WEIGHT * ((action - demos["action"]).square() * better).mean()

    losses = agent.update(batch.clone(), demos.clone())
    plain = make().update(torch.cat((batch, demos)))  # as if they were its own
    torch.testing.assert_close(losses["actor_loss"] - plain["actor_loss"], expected)


@pytest.mark.parametrize("algo", AGENTS)
def test_the_policy_comes_closer_to_demonstrations(env, algo):
    torch.manual_seed(0)
    agent = make_agent(env, Hyperparameters(algo=algo))
    demos = make_transitions(env, 32)
    critics = [x.clone() for x in critics_of(agent)[0]]
    losses = [agent.imitate(demos.clone()) for _ in range(20)]
    assert 0 < losses[-1] < 0.9 * losses[0]
    assert not losses[-1].requires_grad
    assert all(map(torch.equal, critics, critics_of(agent)[0]))


def test_the_policy_imitates_the_more_frequent_of_two_actions(env):
    torch.manual_seed(0)
    agent = make_agent(env, Hyperparameters())
    demos = make_transitions(env, 1).expand(32).clone()
    frequent, rare = torch.tensor((0.6, -0.2, 0.4)), torch.tensor((-0.6, 0.4, -0.4))
    demos["action"] = torch.where(torch.arange(32)[:, None] % 4 > 0, frequent, rare)
    for count in range(300):
        agent.set_learning_rate(1 - count / 300)
        agent.imitate(demos.clone())
    with torch.no_grad():
        action = agent.policy(demos[:1].clone())["action"]
    torch.testing.assert_close(action, frequent[None], atol=0.02, rtol=0)
