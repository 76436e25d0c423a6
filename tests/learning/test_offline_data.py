"""Data of offline learning: rewards, goals and waypoints of sampled transitions."""

import warnings

import pytest
import torch
from tensordict import TensorDict

import torch_panda
from tests.learning.episodes import play_randomly
from tests.learning.gradient_steps import SPACES
from torch_panda.learning.agents import Hyperparameters, find_agent
from torch_panda.learning.agents.batch import Batch
from torch_panda.learning.agents.gciql_nstep import NStepGCIQL
from torch_panda.learning.agents.hiql import HIQL
from torch_panda.learning.buffers import STORED_KEYS
from torch_panda.learning.environments.spaces import read_spaces
from torch_panda.learning.offline_data import OfflineData

MIXTURE = {"current": 0.2, "geometric": 0.5, "random": 0.3}  # OGBench's
GOALS = {"value_goal": MIXTURE, "actor_goal": "future"}


@pytest.fixture(scope="module")
def env():
    with torch_panda.make("PandaReach-v1", num_envs=4, seed=0) as env:
        yield env


@pytest.fixture(scope="module")
def transitions(env):
    """Random episodes of Reach, (200,)."""
    return play_randomly(env).select(*STORED_KEYS).reshape(-1)


def test_the_data_of_the_caller_stay_as_they_are(env, transitions):
    data = transitions.clone()
    data["next", "reward"].fill_(-7.0)
    before = data.clone()
    OfflineData(data, env, GOALS, discount=0.99)
    assert (data == before).all()


def test_rewards_are_those_of_the_value_goal(env, transitions):
    data = OfflineData(transitions.clone(), env, GOALS, discount=0.99)
    batch = data.sample(1_000)
    b = Batch.from_tensordict(batch)
    reached = (batch["next", "achieved_goal"] - b.g).norm(dim=-1) < 0.05
    assert 0.2 < reached.float().mean() < 0.9
    assert torch.equal(b.r, reached.float() - 1)
    assert torch.equal(b.ends, reached)
    for key in ("observation", "action"):
        assert torch.equal(batch[key], transitions[key][batch["index"]])


def test_an_observation_that_holds_numbers_of_the_goal_causes_no_warning():
    with torch_panda.make("PandaPegInsertion-v1", num_envs=16, seed=0) as env:
        data = env.rollout(3).reshape(-1)
        data["collector", "traj_ids"] = torch.arange(len(data)) // 3
        offline = OfflineData(data.select(*STORED_KEYS), env, GOALS, discount=0.99)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            offline.sample(100)


@pytest.mark.parametrize(
    ("algo", "value_goal"),
    [
        ("gcbc", MIXTURE),
        ("gcivl", MIXTURE),
        ("gciql", MIXTURE),
        ("gciql-nstep", MIXTURE),
        ("hiql", MIXTURE),
        ("qrl", "random"),
        ("crl", "geometric"),
    ],
)
def test_each_agent_draws_its_goals(algo, value_goal):
    hp = Hyperparameters(algo=algo, offline=True)
    agent = find_agent(hp)(SPACES, hp)
    expected = {"value_goal": value_goal, "actor_goal": "future"}
    if algo == "hiql":
        expected["waypoint"] = MIXTURE
    assert agent.goal_strategies == expected


def test_geometric_goals_lie_ahead_by_the_horizon_of_the_discount(env):
    """With a discount of 0.9, the mean number of steps is 0.9 / (1 - 0.9) = 9."""
    episode, step = torch.zeros(10_000, dtype=torch.int64), torch.arange(10_000)
    names = torch.stack([episode, step], -1).float()
    named = named_transitions(env, episode, names, torch.zeros(10_000, 1))
    data = OfflineData(named, env, {"value_goal": "geometric"}, discount=0.9)
    torch.manual_seed(0)
    batch = data.sample(5_000)
    ahead = batch["value_goal"][:, 1] - batch["index"]
    assert ahead.mean() == pytest.approx(9, abs=0.7)


@pytest.mark.parametrize("actor_goal", ["future", "geometric"])
def test_waypoints_of_hiql_stay_within_the_episode_and_before_the_goal(env, actor_goal):
    hp = Hyperparameters(algo="hiql", offline=True, gamma=0.99, actor_goal=actor_goal)
    agent = HIQL(read_spaces(env), hp, subgoal_steps=5)
    lengths, episode, step, names, named = name_episodes(env)
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


def test_n_step_rows_stop_at_the_goal_and_at_the_end_of_the_episode(env):
    hp = Hyperparameters(algo="gciql-nstep", offline=True, gamma=0.9)
    agent = NStepGCIQL(read_spaces(env), hp, num_steps=5)
    lengths, episode, step, names, named = name_episodes(env)
    data = OfflineData(named, env, agent.goal_strategies, discount=0.9)
    torch.manual_seed(0)
    batch = agent.extend(data.sample(2_000), data)
    kinds = set()
    for row in batch:
        first, goal = int(row["index"]), row["value_goal"][:2].tolist()
        rewards = []
        for i in range(first, first + 5):
            reached = names[i].tolist() == goal
            rewards.append(0.0 if reached else -1.0)
            ends = step[i] + 1 == lengths[episode[i]]
            if reached or ends:
                break
        assert row["next", "observation"][:2].tolist() == names[i].tolist()
        expected = sum(0.9**k * reward for k, reward in enumerate(rewards))
        assert row["next", "reward"].item() == pytest.approx(expected)
        assert row["next", "terminated"].item() == reached
        assert row["discount"].item() == pytest.approx(0.9 ** len(rewards))
        kinds.add((len(rewards), reached, bool(ends)))
    # Shorter rows reach the goal, end the episode, or both. Rows of five steps may also
    # do neither.
    assert len(kinds) == 4 * 3 + 4


def name_episodes(env):
    """Lengths of episodes; the episode, step and name of each row; and the rows.

    Each row has its name, which is its episode and step, as its observation and goal.
    """
    lengths = [7, 30, 1, 12]
    episode = torch.cat([torch.full((n,), i) for i, n in enumerate(lengths)])
    step = torch.cat([torch.arange(n) for n in lengths])
    names = torch.stack([episode, step], -1).float()
    named = named_transitions(env, episode, names, torch.zeros(50, 1))
    return lengths, episode, step, names, named


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
