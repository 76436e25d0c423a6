"""Tests of the offline agents: losses, sampled goals and learned policies."""

import math

import pytest
import torch
from tensordict import TensorDict

import torch_panda
from torch_panda import datasets
from torch_panda.learning.buffers import STORED_KEYS
from torch_panda.learning.evaluation import evaluate_episodes
from torch_panda.learning.offline import OFFLINE_AGENTS
from torch_panda.learning.offline.base import (
    Batch,
    ascend_and_imitate,
    expectile_loss,
    weighted_regression,
)
from torch_panda.learning.offline.crl import contrastive_loss
from torch_panda.learning.offline.data import OfflineData
from torch_panda.learning.offline.qrl import INTERVALS, IQE
from torch_panda.learning.spaces import read_spaces

STEPS = 50  # of an episode


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


def make_agent(env, algo, **options):
    cls = OFFLINE_AGENTS[algo]
    torch.manual_seed(0)
    hp = cls.Hyperparameters(hidden_size=128, **options)
    return cls(read_spaces(env), hp)


def make_data(env, agent, transitions):
    """The data with the agent's goals; the agent gets their statistics."""
    data = OfflineData(
        transitions.clone(), env, agent.goal_strategies, agent.hp.discount
    )
    batch = agent.extend(data.sample(2_000), data)
    agent.normalizer.update(batch["observation"], batch["actor_goal"])
    return data


@pytest.mark.parametrize(
    ("algo", "options"),
    [
        ("gcbc", {}),
        ("gcivl", {}),
        ("gciql", {}),
        ("hiql", {}),
        ("qrl", {}),
        ("qrl", {"actor_loss": "descend"}),
    ],
)
def test_agents_learn_to_reach(env, transitions, algo, options):
    agent = make_agent(env, algo, **options)
    data = make_data(env, agent, transitions)
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


@pytest.mark.parametrize(
    ("algo", "options"),
    [*((algo, {}) for algo in OFFLINE_AGENTS), ("qrl", {"actor_loss": "descend"})],
)
def test_a_loss_of_the_policy_leaves_the_other_networks_alone(
    env, transitions, algo, options
):
    agent = make_agent(env, algo, **options)
    data = make_data(env, agent, transitions)
    losses = agent.losses(agent.extend(data.sample(32), data))
    names = [name for name in losses if "actor" in name]
    sum(losses[name] for name in names).backward()
    changed = {
        name.split(".")[0]
        for name, parameter in agent.named_parameters(remove_duplicate=True)
        if parameter.grad is not None
    }
    assert changed <= {"actor", "high_actor", "low_actor"}
    assert len(changed) == len(names) > 0


def test_the_action_is_clipped_and_deterministic(env):
    for algo in OFFLINE_AGENTS:
        agent = make_agent(env, algo)
        with torch.no_grad():
            for parameter in agent.policy.parameters():
                parameter.mul_(5)
        td = env.reset()
        actions = [agent.policy(td.clone())["action"] for _ in range(2)]
        assert torch.equal(*actions)
        assert actions[0].shape == (20, 3)
        assert actions[0].abs().max() <= 1


def test_the_data_of_the_caller_stay_as_they_are(env, transitions):
    data = transitions.clone()
    data["next", "reward"].fill_(-7.0)
    before = data.clone()
    OfflineData(data, env, make_agent(env, "gcbc").goal_strategies, discount=0.99)
    assert (data == before).all()


def test_rewards_are_those_of_the_value_goal(env, transitions):
    goals = make_agent(env, "gcivl").goal_strategies
    data = OfflineData(transitions.clone(), env, goals, discount=0.99)
    batch = data.sample(1_000)
    b = Batch.from_tensordict(batch)
    reached = (b.achieved - b.g).norm(dim=-1) < 0.05
    assert 0.2 < reached.float().mean() < 0.9
    assert torch.equal(b.r, reached.float() - 1)
    assert torch.equal(b.mask, 1 - reached.float())
    for key in ("observation", "action"):
        assert torch.equal(batch[key], transitions[key][batch["index"]])


def test_the_expectile_loss_equals_a_calculation_by_hand():
    diff = torch.tensor([2.0, -3.0, 0.0])
    loss = expectile_loss(diff, diff, 0.9)
    torch.testing.assert_close(loss, torch.tensor([0.9 * 4, 0.1 * 9, 0.0]))
    # The advantage alone determines the weight.
    loss = expectile_loss(diff, torch.tensor([-1.0, 1.0, 1.0]), 0.9)
    torch.testing.assert_close(loss, torch.tensor([0.1 * 4, 0.9 * 9, 0.0]))


def test_the_weighted_regression_equals_a_calculation_by_hand():
    log_probs = torch.tensor([-1.0, -2.0, -3.0])
    advantage = torch.tensor([0.0, 0.5, 100.0])
    loss = weighted_regression(log_probs, advantage, 2.0)
    expected = (1 * 1 + math.exp(1) * 2 + 100 * 3) / 3  # the last weight is limited
    assert float(loss) == pytest.approx(expected)


def test_the_scale_of_values_does_not_change_the_policys_loss():
    q, log_probs = torch.randn(50), -torch.rand(50)
    one, ten = (ascend_and_imitate(k * q, log_probs, 0.3) for k in (1, 10))
    torch.testing.assert_close(one, ten, rtol=1e-4, atol=1e-4)
    expected = -q.mean() / q.abs().mean() - 0.3 * log_probs.mean()
    torch.testing.assert_close(one, expected, rtol=1e-4, atol=1e-4)


def test_the_binary_loss_equals_a_calculation_by_hand():
    logits = torch.tensor([[2.0, -1.0], [0.5, 3.0]])
    signs = torch.tensor([[1.0, -1.0], [-1.0, 1.0]])
    expected = torch.log1p((-signs * logits).exp()).mean()
    torch.testing.assert_close(contrastive_loss(logits), expected)


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


def test_a_component_of_iqe_is_the_length_of_the_union():
    d = IQE()
    x, y = torch.zeros(INTERVALS), torch.zeros(INTERVALS)
    # [0, 2] and [1, 3] overlap, [5, 6] stands apart, [9, 8] is empty.
    x[:4] = torch.tensor([1.0, 0.0, 9.0, 5.0])
    y[:4] = torch.tensor([3.0, 2.0, 8.0, 6.0])
    torch.testing.assert_close(d(x, y).detach(), torch.tensor(4.0))


@pytest.mark.parametrize("actor_goal", ["future", "geometric"])
def test_waypoints_of_hiql_stay_within_the_episode_and_before_the_goal(env, actor_goal):
    """Each row has its episode and step as its observation and goal."""
    lengths = [7, 30, 1, 12]
    episode = torch.cat([torch.full((n,), i) for i, n in enumerate(lengths)])
    step = torch.cat([torch.arange(n) for n in lengths])
    names = torch.stack([episode, step], -1).float()
    rows = torch.zeros(50, 1)
    agent = make_agent(env, "hiql", subgoal_steps=5, actor_goal=actor_goal)
    named = named_transitions(env, episode, names, rows)
    data = OfflineData(named, env, agent.goal_strategies, discount=0.9)
    batch = agent.extend(data.sample(5_000), data)
    t = batch["index"]
    last = torch.tensor(lengths)[episode[t]] - 1
    goal = batch["actor_goal"][:, :2]
    high, low, value = (
        batch[f"{name}_waypoint"][:, :2] for name in ("high", "low", "value")
    )
    for name in (goal, high, low):
        assert torch.equal(name[:, 0], episode[t].float())
    assert (goal[:, 1] >= step[t]).all()
    assert (goal[:, 1] <= last).all()
    # A row's next state is one step later, so 4 rows later is 5 steps later.
    assert torch.equal(low[:, 1], torch.minimum(step[t] + 4, last).float())
    assert torch.equal(high[:, 1], torch.minimum(step[t] + 4, goal[:, 1]))
    is_own = (value == names[t]).all(-1)
    assert torch.equal(is_own, batch["reaches_waypoint"])
    assert 0.2 < is_own.float().mean() < 0.5


def named_transitions(env, episode, names, rows):
    """Transitions whose next observation and achieved goal are their names."""
    n, spaces = len(rows), read_spaces(env)
    observation = torch.zeros(n, spaces.observation_size)
    observation[:, :2] = names
    goal = torch.zeros(n, spaces.goal_size)
    goal[:, :2] = names
    no = torch.zeros(n, 1, dtype=torch.bool)
    desired = torch.zeros_like(goal)
    after = {
        "observation": observation,
        "achieved_goal": goal,
        "desired_goal": desired,
        "reward": rows,
        "done": no,
        "terminated": no,
    }
    return TensorDict(
        {
            "observation": torch.zeros_like(observation),
            "desired_goal": desired,
            "action": torch.zeros(n, spaces.action_size),
            "collector": {"traj_ids": episode},
            "next": after,
        },
        [n],
    )
