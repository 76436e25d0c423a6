"""Gradient steps of the agents that learn online equal calculations by hand.

Rewards are -1 or 0 and gamma is 0.75, so returns lie between -4 and 0.
"""

import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from tests.learning import gradient_steps
from tests.learning.gradient_steps import (
    SPACES,
    Expected,
    check_step,
    disperse,
    disturb,
    fill_normalizer,
    parameters_of,
)
from torch_panda.learning.agents import AGENTS, Hyperparameters
from torch_panda.learning.agents.normalizer import Normalizer

LEARNING_RATE = 1e-3
GAMMA = 0.75
TAU = 0.05
# The episodes of these rows go on, except where they end in failure or success.
REWARDS = [-1.0, -1.0, -1.0, -1.0, -1.0, 0.0, -1.0, 0.0]
ENDS = [False, False, False, False, False, False, True, True]


def make_agent(algo, seed=0, **options):
    torch.manual_seed(seed)
    hp = Hyperparameters(algo=algo, gamma=GAMMA, **options)
    agent = AGENTS[algo](gradient_steps.SPACES, hp)
    fill_normalizer(agent)
    return agent


def make_rows(rewards=REWARDS, ends=ENDS):
    n = len(rewards)
    goal = torch.randn(n, gradient_steps.SPACES.goal_size)
    after = {
        "observation": torch.randn(n, gradient_steps.SPACES.observation_size),
        "desired_goal": goal,
        "reward": torch.tensor(rewards).unsqueeze(-1),
        "terminated": torch.tensor(ends).unsqueeze(-1),
    }
    after["done"] = after["terminated"]
    rows = {
        "observation": torch.randn(n, gradient_steps.SPACES.observation_size),
        "desired_goal": goal,
        "action": 2 * torch.rand(n, gradient_steps.SPACES.action_size) - 1,
        "next": after,
    }
    return TensorDict(rows, [n])


def states(agent, rows):
    """The inputs of the networks before and after the step of each row."""
    goal = rows["desired_goal"]
    return tuple(
        agent.normalizer(part["observation"], goal) for part in (rows, rows["next"])
    )


def target_values(next_values, lowest=-4.0, highest=0.0, rewards=REWARDS):
    """The value that the critics learn for each row, (n,)."""
    targets = []
    for reward, ends, value in zip(rewards, ENDS, next_values.tolist(), strict=True):
        if ends:
            # A failure counts as if the goal were never reached: -1 - 0.75 - ... = -4.
            targets.append(0.0 if reward == 0 else -4.0)
        else:
            targets.append(min(max(reward + GAMMA * value, lowest), highest))
    return torch.tensor(targets)


def actor_terms(agent, state):
    """The actions of a deterministic actor, and the penalties on them."""
    before_tanh = agent.actor[0](state)
    action = before_tanh.tanh()
    return action, (action**2).mean() + 0.01 * (before_tanh**2).mean()


def make_dispersed(algo, **options):
    """An agent whose values lie on both sides of the possible returns."""
    agent = make_agent(algo, **options)
    for critic in (*agent.critics, *agent.target_critics):
        disperse(critic, scale=10, bias=-3)
    for actor in (agent.actor, agent.target_actor):
        disperse(actor, scale=3)
    return agent


def target_networks(agent):
    return (
        parameters_of(agent.target_actor, agent.target_critics),
        parameters_of(agent.actor, agent.critics),
    )


def test_ddpg_takes_the_calculated_step():
    agent, rows = make_dispersed("ddpg"), make_rows()
    [critic], [target_critic] = agent.critics, agent.target_critics
    state, next_state = states(agent, rows)
    next_value = target_critic(next_state, agent.target_actor(next_state))[:, 0]
    target = target_values(next_value)
    assert {-4.0, 0.0} < {*target[:6].tolist()}  # some are clipped, others are not
    critic_loss = ((critic(state, rows["action"])[:, 0] - target) ** 2).mean()
    action, penalty = actor_terms(agent, state)
    actor_loss = penalty - critic(state, action).mean()
    expected = {
        "critic_loss": Expected(critic_loss, parameters_of(critic), LEARNING_RATE),
        "actor_loss": Expected(actor_loss, parameters_of(agent.actor), LEARNING_RATE),
    }
    check_step(agent, lambda: agent.update(rows), expected, target_networks(agent), TAU)


def test_ddpg_learns_a_critic_for_each_part(monkeypatch):
    """Each critic has its rewards and weights, and the actor maximises their mean."""
    monkeypatch.setattr(gradient_steps, "SPACES", replace(SPACES, goal_size=6))
    weights = torch.stack((torch.ones(11), torch.linspace(0.1, 1.1, 11)))
    monkeypatch.setattr(Normalizer, "part_weights", lambda _: weights)
    agent = make_dispersed("ddpg", critics="parts")
    rows = make_rows()
    others = torch.tensor([0.0, -1.0, -1.0, 0.0, -1.0, -1.0, 0.0, 0.0])
    rewards = torch.stack((torch.tensor(REWARDS), others), 1)
    rows["next", "reward"] = rewards
    state, next_state = states(agent, rows)
    next_action = agent.target_actor(next_state)
    action, actor_loss = actor_terms(agent, state)
    critic_loss = 0.0
    for k, (critic, target_critic) in enumerate(
        zip(agent.critics, agent.target_critics, strict=True)
    ):
        next_value = target_critic(next_state * weights[k], next_action)[:, 0]
        target = target_values(next_value, rewards=rewards[:, k].tolist())
        value = critic(state * weights[k], rows["action"])[:, 0]
        critic_loss = critic_loss + ((value - target) ** 2).mean()
        actor_loss = actor_loss - critic(state * weights[k], action).mean() / 2
    critics = parameters_of(agent.critics)
    expected = {
        "critic_loss": Expected(critic_loss, critics, LEARNING_RATE),
        "actor_loss": Expected(actor_loss, parameters_of(agent.actor), LEARNING_RATE),
    }
    check_step(agent, lambda: agent.update(rows), expected, target_networks(agent), TAU)


@pytest.mark.parametrize(("lowest", "highest"), [(None, math.inf), (-math.inf, 0.0)])
def test_only_possible_bounds_clip_targets(lowest, highest):
    """Returns of other rewards have no bounds; without discount they have no minimum.

    A failure then keeps its reward.
    """
    agent, rows = make_dispersed("ddpg"), make_rows()
    agent.min_return = lowest
    state, next_state = states(agent, rows)
    with torch.no_grad():
        next_value = agent.target_critics[0](next_state, agent.target_actor(next_state))
        target = target_values(next_value[:, 0], -math.inf, highest)
        target[6] = -1.0
        difference = agent.critics[0](state, rows["action"])[:, 0] - target
    loss = agent.update(rows)["critic_loss"]
    torch.testing.assert_close(loss, (difference**2).mean())


@pytest.mark.parametrize("algo", ["ddpg", "td3"])
def test_ddpg_and_td3_imitate_demonstrations_that_their_critic_prefers(algo):
    agent, rows = make_dispersed(algo), make_rows()
    demos = make_rows([-1.0, -1.0, 0.0], [False, False, True])
    state, critic = states(agent, demos)[0], agent.critics[0]
    prefers = critic(state, demos["action"]) > critic(state, agent.actor(state))
    assert 0 < prefers.sum() < 3
    # Demonstrations are also rows of the batch.
    both = states(agent, torch.cat((rows, demos)))[0]
    action, penalty = actor_terms(agent, both)
    squares = [
        (a - demo) ** 2 if is_preferred else torch.zeros(3)
        for a, demo, is_preferred in zip(
            agent.actor(state), demos["action"], prefers, strict=True
        )
    ]
    imitation = torch.stack(squares).mean()
    loss = penalty - critic(both, action).mean() + 20 * imitation
    gradients = torch.autograd.grad(loss, parameters_of(agent.actor))
    losses = agent.update(rows, demos)
    torch.testing.assert_close(losses["actor_loss"], loss.detach())
    for p, gradient in zip(parameters_of(agent.actor), gradients, strict=True):
        torch.testing.assert_close(p.grad, gradient, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("double_q", [True, False])
def test_td3_takes_the_calculated_step(double_q, monkeypatch):
    agent, rows = make_dispersed("td3", double_q=double_q), make_rows()
    assert len(agent.critics) == (2 if double_q else 1)
    state, next_state = states(agent, rows)
    draws = torch.linspace(-5, 5, 24)[torch.randperm(24)].view(8, 3)
    monkeypatch.setattr(torch, "randn_like", lambda action: draws)

    def targets(noise):
        action = (agent.target_actor(next_state) + noise).clamp(-1, 1)
        values = [critic(next_state, action)[:, 0] for critic in agent.target_critics]
        return target_values(torch.stack(values).amin(0))

    target = targets((0.2 * draws).clamp(-0.5, 0.5))
    assert (target - targets(0.2 * draws)).abs().max() > 0.1  # some noise is clipped
    critic_loss = sum(
        ((critic(state, rows["action"])[:, 0] - target) ** 2).mean()
        for critic in agent.critics
    )
    action, penalty = actor_terms(agent, state)
    actor_loss = penalty - agent.critics[0](state, action).mean()
    trained = parameters_of(agent.critics)
    expected = {
        "critic_loss": Expected(critic_loss, trained, LEARNING_RATE),
        "actor_loss": Expected(actor_loss, parameters_of(agent.actor), LEARNING_RATE),
    }
    check_step(agent, lambda: agent.update(rows), expected, target_networks(agent), TAU)
    # Every second step trains the critics only.
    actor = [p.detach().clone() for p in agent.actor.parameters()]
    assert agent.update(rows).keys() == {"critic_loss"}
    assert all(map(torch.equal, actor, agent.actor.parameters()))
    assert agent.update(rows).keys() == {"critic_loss", "actor_loss"}


def sac_distribution(agent, state):
    """The squashed Gaussian of the trained policy; torchrl computes its density."""
    inputs = TensorDict({"normalized": state}, [len(state)])
    return agent.explore.module[1].get_dist(inputs)


def sac_values(agent, networks, state, action):
    """Outputs of all critics, (critics, n, 1)."""
    inputs = TensorDict({"normalized": state, "action": action}, [len(state)])
    values = []
    for parameters in networks.unbind(0):
        with parameters.to_module(agent.loss.qvalue_network):
            outputs = agent.loss.qvalue_network(inputs.clone())
        values.append(outputs["state_action_value"])
    return torch.stack(values)


def sac_networks(agent):
    """The critics and their targets, which differ from now on."""
    online = agent.loss.qvalue_network_params
    target = agent.loss.target_qvalue_network_params
    with torch.no_grad():
        disturb(target.values(True, True))
    return online, target


@pytest.mark.parametrize("double_q", [True, False])
def test_sac_takes_the_calculated_step(double_q):
    agent, rows = make_agent("sac", double_q=double_q), make_rows()
    online, target = sac_networks(agent)
    assert len(online) == (2 if double_q else 1)
    state, next_state = states(agent, rows)
    torch.manual_seed(1)
    next_policy, policy = (sac_distribution(agent, x) for x in (next_state, state))
    next_action, action = next_policy.rsample(), policy.rsample()
    next_value = sac_values(agent, target, next_state, next_action)[..., 0].amin(0)
    next_value = next_value - 0.2 * next_policy.log_prob(next_action)
    # SAC does not clip its targets, because the entropy is a part of the return.
    values = target_values(next_value, -math.inf, math.inf)
    q = sac_values(agent, online, state, rows["action"])[..., 0]
    critic_loss = ((q - values) ** 2).mean(1).sum()
    value = sac_values(agent, online, state, action)[..., 0].amin(0)
    actor_loss = (0.2 * policy.log_prob(action) - value).mean()
    actor = [*agent.loss.actor_network_params.parameters()]
    expected = {
        "critic_loss": Expected(critic_loss, [*online.parameters()], LEARNING_RATE),
        "actor_loss": Expected(actor_loss, actor, LEARNING_RATE),
    }
    keys = [*online.keys(True, True)]
    targets = [target[key] for key in keys], [online[key] for key in keys]
    torch.manual_seed(1)
    check_step(agent, lambda: agent.update(rows), expected, targets, TAU)


def test_crl_takes_the_calculated_step():
    """Neither rewards nor ends of episodes are used."""
    agent, rows = make_agent("crl"), make_rows()
    state, _ = states(agent, rows)
    s, goal = state[:, : SPACES.observation_size], rows["desired_goal"]
    phi, psi = agent.phi(s, rows["action"]), agent.psi(agent.normalizer.goal(goal))
    assert phi.shape == psi.shape == (8, 64)
    f = torch.stack([torch.stack([-(x - y).norm() for y in psi]) for x in phi])
    critic_loss = 0.0
    for i in range(8):
        row, column = f[i].exp().sum().log(), f[:, i].exp().sum().log()
        critic_loss += (row + column - 2 * f[i, i] + 0.1 * row**2) / 8

    others = [6, 1, 0, 3, 2, 5, 4, 7]  # half of the goals belong to other rows
    state = agent.normalizer(rows["observation"], goal[others])
    action, penalty = actor_terms(agent, state)
    distance = (agent.phi(s, action) - psi[others]).norm(dim=-1)
    actor_loss = penalty + distance.mean()
    critic = parameters_of(agent.phi, agent.psi)
    expected = {
        "critic_loss": Expected(critic_loss, critic, LEARNING_RATE),
        "actor_loss": Expected(actor_loss, parameters_of(agent.actor), LEARNING_RATE),
    }
    check_step(agent, lambda: agent.update(rows), expected)


@pytest.mark.parametrize("algo", AGENTS)
def test_imitation_takes_the_calculated_step(algo):
    """The loss is the mean absolute difference. Only the policy learns."""
    agent, demos = make_agent(algo), make_rows()
    actor = agent.explore.module[1]
    state, _ = states(agent, demos)
    if algo == "sac":
        action = sac_distribution(agent, state).deterministic_sample
    else:
        action = agent.actor(state)
    loss = (action - demos["action"]).abs().mean()
    rate = 0.5 * LEARNING_RATE
    agent.set_learning_rate(0.5)
    expected = {"loss": Expected(loss, parameters_of(actor), rate)}
    targets, tau = ((), ()), 0.0
    if algo in ("ddpg", "td3"):
        targets, tau = target_networks(agent), TAU
    check_step(agent, lambda: {"loss": agent.imitate(demos)}, expected, targets, tau)
