"""Gradient steps of the agents that learn offline equal calculations by hand."""

import math

import pytest
import torch
from tensordict import TensorDict

from tests.learning.gradient_steps import (
    SPACES,
    Expected,
    check_step,
    disperse,
    disturb,
    fill_normalizer,
    parameters_of,
)
from torch_panda.learning.agents import (
    OFFLINE_AGENTS,
    Hyperparameters,
    find_agent,
    networks,
)
from torch_panda.learning.agents.qrl import INTERVALS, IQE

LEARNING_RATE = 3e-4
DISCOUNT = 0.99
TAU = 0.005
REACHES = [False, True, False, False]  # whether each row reaches its value goal


@pytest.fixture(autouse=True)
def _small_networks(monkeypatch):
    monkeypatch.setattr(networks, "HIDDEN_SIZE", 32)


def make_agent(algo, **options):
    torch.manual_seed(0)
    hp = Hyperparameters(algo=algo, offline=True, network="gelu", gamma=DISCOUNT)
    agent = find_agent(hp)(SPACES, hp, **options)
    fill_normalizer(agent)
    return agent


def make_rows():
    n = len(REACHES)

    def observations():
        return torch.randn(n, SPACES.observation_size)

    def goals():
        return torch.randn(n, SPACES.goal_size)

    reaches = torch.tensor(REACHES).unsqueeze(-1)
    after = {
        "observation": observations(),
        "achieved_goal": goals(),
        "reward": reaches.float() - 1,
        "terminated": reaches,
    }
    rows = {
        "observation": observations(),
        "action": 2 * torch.rand(n, SPACES.action_size) - 1,
        "value_goal": goals(),
        "actor_goal": goals(),
        "next": after,
    }
    return TensorDict(rows, [n])


def inputs(agent, rows, goal):
    """The inputs of networks of states and goals, before and after the step."""
    return tuple(
        agent.normalizer(part["observation"], rows[goal])
        for part in (rows, rows["next"])
    )


def states(agent, rows):
    """The inputs of networks of states alone, before and after the step."""
    size = SPACES.observation_size
    return tuple(x[:, :size] for x in inputs(agent, rows, "value_goal"))


def trains(loss, *networks):
    return Expected(loss, parameters_of(*networks), LEARNING_RATE)


def log_probs(mean, x):
    """Log densities of Gaussians with unit variance, without their constant."""
    return -((x - mean) ** 2).sum(-1) / 2


def pair_of_values(network, *inputs):
    """The two values of an ensemble, (2, n)."""
    return torch.stack([net(*inputs)[:, 0] for net in network])


def expectile_regression(target, value, old_value, expectile):
    """The loss of two values, whose old values say which rows are good.

    A row is good if the smaller of its two targets is above the mean old value.
    """
    total, signs = 0.0, set()
    for i in range(len(REACHES)):
        is_good = bool(target[:, i].min() >= old_value[:, i].mean())
        weight = expectile if is_good else 1 - expectile
        total += weight * ((target[:, i] - value[:, i]) ** 2).sum()
        signs.add(is_good)
    assert signs == {True, False}
    return total / len(REACHES)


def weighted_imitation(log_probs, advantages, alpha):
    """Imitation with the weights exp(alpha * advantage), at most 100."""
    weights = [min(math.exp(alpha * a), 100.0) for a in advantages.tolist()]
    assert min(weights) < 1
    return -(torch.tensor(weights) * log_probs).mean(), max(weights)


def ascent(q, log_probs, alpha):
    """Ascend q, divided by its mean magnitude, and imitate with weight alpha."""
    return -q.mean() / q.detach().abs().mean() - alpha * log_probs.mean()


def test_gcbc_takes_the_calculated_step():
    agent, rows = make_agent("gcbc"), make_rows()
    x, _ = inputs(agent, rows, "actor_goal")
    loss = -log_probs(agent.actor(x), rows["action"]).mean()
    expected = {"actor_loss": trains(loss, agent.actor)}
    check_step(agent, lambda: agent.update(rows), expected)
    assert agent.updates == 1


def test_gcivl_takes_the_calculated_step():
    agent, rows = make_agent("gcivl"), make_rows()
    for net in (*agent.value, *agent.target_value):
        disperse(net, scale=6)
    x, x_next = inputs(agent, rows, "value_goal")
    v_next = pair_of_values(agent.target_value, x_next)
    # The second row reaches its goal, so its return is 0.
    target = torch.tensor([-1.0, 0.0, -1.0, -1.0]) + DISCOUNT * v_next
    target[:, 1] = 0.0
    value_loss = expectile_regression(
        target.detach(),
        pair_of_values(agent.value, x),
        pair_of_values(agent.target_value, x),
        expectile=0.9,
    )
    x, x_next = inputs(agent, rows, "actor_goal")
    v, v_next = (pair_of_values(agent.value, values).mean(0) for values in (x, x_next))
    log_prob = log_probs(agent.actor(x), rows["action"])
    actor_loss, largest = weighted_imitation(log_prob, v_next - v, alpha=10.0)
    assert largest == 100
    expected = {
        "value_loss": trains(value_loss, agent.value),
        "actor_loss": trains(actor_loss, agent.actor),
    }
    targets = parameters_of(agent.target_value), parameters_of(agent.value)
    check_step(agent, lambda: agent.update(rows), expected, targets, TAU)


@pytest.mark.parametrize("algo", ["gciql", "gciql-nstep"])
def test_gciql_takes_the_calculated_step(algo):
    agent, rows = make_agent(algo), make_rows()
    discounts = [DISCOUNT] * 4
    if algo == "gciql-nstep":
        discounts = [0.9, 0.5, 0.7, 0.2]
        rows["discount"] = torch.tensor(discounts)
        # The second row reaches its goal, after a step that did not.
        rows["next", "reward"][1] = -1.0
    disperse(agent.value, scale=4, bias=-5)
    for net in (*agent.critic, *agent.target_critic):
        disperse(net, scale=4)
    disperse(agent.actor, scale=2)
    action = rows["action"]
    x, x_next = inputs(agent, rows, "value_goal")
    v, q_target = agent.value(x)[:, 0], pair_of_values(agent.target_critic, x, action)
    difference = q_target.amin(0).detach() - v
    assert (difference < 0).any() > (difference < 0).all()
    weights = torch.tensor([0.9 if d >= 0 else 0.1 for d in difference.tolist()])
    value_loss = (weights * difference**2).mean()

    v_next = agent.value(x_next)[:, 0].tolist()
    target = torch.tensor(
        [-1 + discount * v for discount, v in zip(discounts, v_next, strict=True)]
    )
    target[1] = rows["next", "reward"][1]  # the second row reaches its goal
    q = pair_of_values(agent.critic, x, action)
    critic_loss = ((q - target) ** 2).mean(1).sum()

    x, _ = inputs(agent, rows, "actor_goal")
    mean = agent.actor(x)
    assert (mean.abs() > 1).any()
    q = pair_of_values(agent.critic, x, mean.clamp(-1, 1)).amin(0)
    actor_loss = ascent(q, log_probs(mean, action), alpha=0.3)
    expected = {
        "value_loss": trains(value_loss, agent.value),
        "critic_loss": trains(critic_loss, agent.critic),
        "actor_loss": trains(actor_loss, agent.actor),
    }
    targets = parameters_of(agent.target_critic), parameters_of(agent.critic)
    check_step(agent, lambda: agent.update(rows), expected, targets, TAU)


def test_hiql_takes_the_calculated_step():
    agent, rows = make_agent("hiql"), make_rows()
    for part in (agent.online, agent.target):
        for net in (*part["waypoint_value"], *part["goal_value"]):
            disperse(net, scale=2)
    disturb(agent.target["phi"].parameters())
    for name in ("value", "high", "low"):
        rows[f"{name}_waypoint"] = torch.randn(4, SPACES.observation_size)
    reaches_waypoint = [False, False, True, False]
    rows["reaches_waypoint"] = torch.tensor(reaches_waypoint)
    s, s_next = states(agent, rows)

    def represent(phi, s, waypoint):
        """phi(s, w) as a vector of length sqrt(10)."""
        w = agent.normalizer(rows[waypoint], rows["value_goal"])
        z = phi(s, w[:, : SPACES.observation_size])
        return z * math.sqrt(10) / z.norm(dim=-1, keepdim=True)

    old = agent.target["goal_value"]
    x, x_next = inputs(agent, rows, "value_goal")
    target = DISCOUNT * pair_of_values(old, x_next) - 1
    target[:, 1] = 0.0  # the second row reaches its goal
    goal_value_loss = expectile_regression(
        target.detach(),
        pair_of_values(agent.goal_value, x),
        pair_of_values(old, x),
        expectile=0.7,
    )

    old, old_phi = agent.target["waypoint_value"], agent.target["phi"]
    z_next = represent(old_phi, s_next, "value_waypoint")
    target = DISCOUNT * pair_of_values(old, s_next, z_next) - 1
    target[:, 2] = 0.0  # the third row reaches its waypoint
    z = represent(agent.phi, s, "value_waypoint")
    waypoint_value_loss = expectile_regression(
        target.detach(),
        pair_of_values(agent.waypoint_value, s, z),
        pair_of_values(old, s, represent(old_phi, s, "value_waypoint")),
        expectile=0.7,
    )

    # The high level imitates waypoints that are closer to the goal.
    x, _ = inputs(agent, rows, "actor_goal")
    x_later = agent.normalizer(rows["high_waypoint"], rows["actor_goal"])
    v, v_later = (
        pair_of_values(agent.goal_value, values).mean(0) for values in (x, x_later)
    )
    z = represent(agent.phi, s, "high_waypoint").detach()
    high_actor_loss, _ = weighted_imitation(
        log_probs(agent.high_actor(x), z), v_later - v, alpha=3.0
    )
    # The low level imitates actions that lead towards the waypoint.
    z = represent(agent.phi, s, "low_waypoint").detach()
    z_next = represent(agent.phi, s_next, "low_waypoint")
    v = pair_of_values(agent.waypoint_value, s, z).mean(0)
    v_next = pair_of_values(agent.waypoint_value, s_next, z_next).mean(0)
    low_actor_loss, _ = weighted_imitation(
        log_probs(agent.low_actor(s, z), rows["action"]), v_next - v, alpha=3.0
    )
    expected = {
        "goal_value_loss": trains(goal_value_loss, agent.goal_value),
        "waypoint_value_loss": trains(
            waypoint_value_loss, agent.waypoint_value, agent.phi
        ),
        "high_actor_loss": trains(high_actor_loss, agent.high_actor),
        "low_actor_loss": trains(low_actor_loss, agent.low_actor),
    }
    targets = parameters_of(agent.target), parameters_of(agent.online)
    check_step(agent, lambda: agent.update(rows), expected, targets, TAU)


def make_qrl():
    """An agent with costs between 0 and 60, and with lambda = 1.5."""
    agent, rows = make_agent("qrl", num_components=4), make_rows()
    for net in (agent.state_encoder, agent.goal_encoder):
        disperse(net, scale=3)
    agent.quasimetric.mixture.data.fill_(0.3)
    agent.log_lambda.data.fill_(math.log(1.5))
    return agent, rows


def qrl_losses(agent, rows):
    """The losses of quasimetric and multiplier."""
    d = agent.quasimetric
    s, s_next = states(agent, rows)
    z, z_next = agent.state_encoder(s), agent.state_encoder(s_next)
    goal, achieved = (
        agent.goal_encoder(agent.normalizer.goal(x))
        for x in (rows["value_goal"], rows["next", "achieved_goal"])
    )
    # softplus with slope 0.1, of 50 minus the cost to random goals
    push = (10 * (1 + (0.1 * (50 - d(z, goal))).exp()).log()).mean()
    steps = d(z, z_next)
    assert (steps > 1).any()
    too_far = torch.stack([max(cost - 1, 0 * cost) ** 2 for cost in steps]).mean()
    violation = too_far + (d(z_next, achieved) ** 2).mean()
    multiplier = agent.log_lambda.exp()
    networks = (agent.state_encoder, agent.goal_encoder, d)
    multiplier_loss = multiplier * (0.25**2 - violation.detach())
    return {
        "value_loss": trains(push + 1.5 * violation, *networks),
        "multiplier_loss": Expected(multiplier_loss, [agent.log_lambda], 0.01),
    }


def test_qrl_takes_the_calculated_step():
    agent, rows = make_qrl()
    goal = agent.goal_encoder(agent.normalizer.goal(rows["actor_goal"]))
    before, after = (
        agent.quasimetric(agent.state_encoder(s), goal) for s in states(agent, rows)
    )
    x, _ = inputs(agent, rows, "actor_goal")
    log_prob = log_probs(agent.actor(x), rows["action"])
    loss, _ = weighted_imitation(log_prob, before - after, alpha=10.0)
    expected = {**qrl_losses(agent, rows), "actor_loss": trains(loss, agent.actor)}
    check_step(agent, lambda: agent.update(rows), expected)


@pytest.mark.parametrize("mixture", [-3.0, 0.0, 3.0])
def test_iqe_is_a_quasimetric(mixture):
    torch.manual_seed(0)
    d = IQE()
    d.mixture.data.fill_(mixture)
    x, y, z = torch.randn(3, 1_000, 4 * INTERVALS)
    assert torch.equal(d(x, x), torch.zeros(1_000))
    assert (d(x, y) >= 0).all()
    assert (d(x, z) <= d(x, y) + d(y, z) + 1e-5).all()
    assert not torch.allclose(d(x, y), d(y, x))


def test_iqe_mixes_maximum_and_mean_of_the_lengths_of_unions():
    d = IQE()
    d.mixture.data.fill_(math.log(3.0))  # three parts of the maximum, one of the mean
    x, y = torch.zeros(2 * INTERVALS), torch.zeros(2 * INTERVALS)
    # [0, 2] and [1, 3] overlap, [5, 6] stands apart, [9, 8] is empty.
    x[:4] = torch.tensor([1.0, 0.0, 9.0, 5.0])
    y[:4] = torch.tensor([3.0, 2.0, 8.0, 6.0])
    expected = torch.tensor(0.75 * 4.0 + 0.25 * (4.0 + 0.0) / 2)
    torch.testing.assert_close(d(x, y).detach(), expected)


def test_crl_takes_the_calculated_step():
    agent, rows = make_agent("crl"), make_rows()
    for net in (*agent.phi, *agent.psi):
        disperse(net, scale=1)
    disperse(agent.actor, scale=2)
    s, _ = states(agent, rows)
    goal = agent.normalizer.goal(rows["value_goal"])
    terms = []
    for phi, psi in zip(agent.phi, agent.psi, strict=True):
        x, y = phi(s, rows["action"]), psi(goal)
        for i in range(4):
            for j in range(4):
                f = x[i] @ y[j] / math.sqrt(128)  # the size of both
                own = 1 if i == j else -1
                terms.append((1 + (-own * f).exp()).log())
    critic_loss = torch.stack(terms).mean()

    x, _ = inputs(agent, rows, "actor_goal")
    mean = agent.actor(x)
    assert (mean.abs() > 1).any()
    goal = agent.normalizer.goal(rows["actor_goal"])
    f = torch.stack(
        [
            (phi(s, mean.clamp(-1, 1)) * psi(goal)).sum(-1) / math.sqrt(128)
            for phi, psi in zip(agent.phi, agent.psi, strict=True)
        ]
    )
    log_prob = log_probs(mean, rows["action"])
    actor_loss = ascent(f.amin(0), log_prob, alpha=0.1)
    expected = {
        "critic_loss": trains(critic_loss, agent.phi, agent.psi),
        "actor_loss": trains(actor_loss, agent.actor),
    }
    check_step(agent, lambda: agent.update(rows), expected)


@pytest.mark.parametrize("algo", OFFLINE_AGENTS)
def test_the_policy_clips_the_mean_action(algo):
    agent, rows = make_agent(algo), make_rows()
    if algo == "hiql":
        actor = agent.low_actor
        z = agent.high_actor(inputs(agent, rows, "actor_goal")[0])
        z = z * math.sqrt(10) / z.norm(dim=-1, keepdim=True)
        network_inputs = (states(agent, rows)[0], z)
    else:
        actor = agent.actor
        network_inputs = inputs(agent, rows, "actor_goal")[:1]
    disperse(actor, scale=3)
    td = TensorDict({"observation": rows["observation"]}, [4])
    td["desired_goal"] = rows["actor_goal"]
    mean = actor(*network_inputs)
    assert (mean.abs() > 1).any() > (mean.abs() > 1).all()
    torch.testing.assert_close(agent.policy(td)["action"], mean.clamp(-1, 1))
