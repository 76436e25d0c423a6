"""Training episodes that start in rare states which the agent has reached."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

import torch_panda
from torch_panda.learning.environments import starts
from torch_panda.learning.environments.starts import StartReached, weigh

NUM_ENVS = 8


def make_states(achieved, *, speed=0.0, desired=(0.1, 0.1, 0.02), step_count=1):
    """States (n,) with these achieved goals."""
    achieved = torch.tensor(achieved)
    number = len(achieved)
    velocity = torch.zeros(number, 1, 6, dtype=torch.float64)
    velocity[..., 1] = speed
    return TensorDict(
        {
            "achieved_goal": achieved,
            "desired_goal": torch.tensor(desired, dtype=torch.float64).expand(
                number, -1
            ),
            "object_velocity": velocity,
            "step_count": torch.full((number, 1), step_count),
        },
        [number],
    )


START = make_states([(-0.1, -0.1, 0.02)], step_count=0)


def test_a_state_with_fewer_neighbours_is_likelier():
    torch.manual_seed(0)
    common = make_states([(0.0, 0.0, 0.02 + 0.0001 * k) for k in range(80)])
    rare = make_states([(0.05, 0.0, 0.02 + 0.0001 * k) for k in range(20)])
    weights = weigh(torch.cat((START, common, rare)))
    assert weights[1] == weights[80]
    # There are four times as many common states as rare ones.
    assert float(weights[-1] / weights[1]) == pytest.approx(4**2.5, rel=0.3)


def test_a_state_is_rare_if_one_of_its_objects_is_at_a_rare_place():
    on_table = (0.0, 0.0, 0.02)
    goals = [(*on_table, *on_table)] * 50
    lifted = [(*on_table, 0.0, 0.0, 0.06), (0.0, 0.0, 0.06, *on_table)]
    states = make_states(goals + lifted, desired=(*on_table, 0.0, 0.0, 0.06))
    states["step_count"][:] = 0
    weights = weigh(states)
    assert (weights[50:] > 100 * weights[:50].max()).all()


def test_states_with_fast_or_distant_objects_are_left_out():
    """Distant from the starts and the desired goals, of which both ends count."""
    kept = [(-0.14, 0.0, 0.02), (0.14, 0.0, 0.02), (0.0, 0.0, 0.06)]
    distant = [(-0.16, 0.0, 0.02), (0.16, 0.0, 0.02), (0.0, 0.0, -0.04)]
    states = torch.cat(
        (
            *(START, make_states(kept), make_states(distant)),
            *(make_states(kept, speed=0.49), make_states(kept, speed=-0.51)),
        )
    )
    is_drawn = weigh(states) > 0
    assert is_drawn.tolist() == [True] * 4 + [False] * 3 + [True] * 3 + [False] * 3


@pytest.fixture
def env(monkeypatch):
    """Push with starts in all states that it reached, after the first of them."""
    monkeypatch.setattr(starts, "FEWEST", 2 * NUM_ENVS + 1)
    monkeypatch.setattr(starts, "KEPT", 1.0)
    torch.manual_seed(0)
    with torch_panda.make("PandaPush-v1", num_envs=NUM_ENVS, seed=0) as base:
        yield TransformedEnv(base, StartReached(1.0))


def test_the_latest_states_are_kept(env, monkeypatch):
    start = env.reset()
    states = env.transform.states
    assert (states[:]["step_count"] == 0).all()
    assert (states[:]["achieved_goal"] == start["achieved_goal"]).all()
    td = env.step(env.rand_action(start))["next"]
    state = env.base_env.get_state()
    assert len(states) == 2 * NUM_ENVS
    kept = states[NUM_ENVS:]
    assert (kept["achieved_goal"] == td["achieved_goal"]).all()
    assert all((kept[key] == value).all() for key, value in state.items())


def prefer_moving(states):
    """Weights of states that are not the usual starts."""
    return (states["step_count"] > 0).double().squeeze(1)


def test_episodes_start_in_reached_states_with_goals_of_their_own(env, monkeypatch):
    monkeypatch.setattr(starts, "weigh", prefer_moving)
    env.reset()
    env.rollout(5)
    td = env.reset()
    states = env.transform.states[:]  # with the usual starts of this reset
    state = env.base_env.get_state()
    is_kept = torch.ones(len(states), NUM_ENVS, dtype=torch.bool)
    for key in ("joint_position", "joint_velocity", "object_pose", "object_velocity"):
        equal = (states[key].unsqueeze(1) - state[key]).abs() < 1e-9
        is_kept &= equal.flatten(2).all(-1)
    assert is_kept.any(0).all()
    assert (states["step_count"][is_kept.any(1)] > 0).all()
    assert (state["step_count"] == 0).all()
    assert (state["desired_goal"].float() == td["desired_goal"]).all()
    assert len(states["desired_goal"].unique(dim=0)) == 3 * NUM_ENVS  # of three resets
    drawn = states["desired_goal"][-NUM_ENVS:]
    torch.testing.assert_close(state["desired_goal"], drawn, rtol=0, atol=1e-7)
    assert env.rollout(3).shape == (NUM_ENVS, 3)


def test_episodes_start_as_usual_if_no_state_fits(env, monkeypatch):
    env.rollout(5)
    monkeypatch.setattr(starts, "weigh", lambda states: torch.zeros(len(states)))
    assert (env.reset()["observation"][:, 3:6] == 0).all()  # the hand rests


def test_a_ratio_of_the_episodes_starts_there(env, monkeypatch):
    monkeypatch.setattr(starts, "weigh", prefer_moving)
    env.rollout(5)
    env.transform.ratio = 0.3
    torch.manual_seed(0)
    observations = torch.stack([env.reset()["observation"] for _ in range(50)])
    moves = (observations[..., 3:6] != 0).any(-1)
    assert 0.2 < moves.double().mean() < 0.4
    assert moves.any(0).all()
    assert not moves.all(1).any()


def test_a_partial_reset_starts_only_its_own_there(env):
    env.reset()
    td = env.rollout(5)[:, -1]["next"]
    before = env.base_env.get_state()
    td["_reset"] = torch.zeros(NUM_ENVS, 1, dtype=torch.bool)
    td["_reset"][2] = True
    after = env.reset(td)
    state = env.base_env.get_state()
    others = torch.arange(NUM_ENVS) != 2
    assert (state[others] == before[others]).all()
    assert (after["observation"][others] == td["observation"][others]).all()
    assert state["step_count"].flatten().tolist() == [5, 5, 0, 5, 5, 5, 5, 5]


@pytest.mark.usefixtures("env")  # for its constants
def test_states_that_were_weighed_stay_starts_when_later_ones_replace_them(monkeypatch):
    def prefer_first(states):
        return (torch.arange(len(states)) == 0).double()

    monkeypatch.setattr(starts, "weigh", prefer_first)
    monkeypatch.setattr(starts, "CAPACITY", NUM_ENVS)
    monkeypatch.setattr(starts, "FEWEST", NUM_ENVS)
    with torch_panda.make("PandaPush-v1", num_envs=NUM_ENVS, seed=0) as base:
        env = TransformedEnv(base, StartReached(1.0))
        td = env.reset()
        first = env.transform.states[0].clone()
        td = env.step(env.rand_action(td))["next"]
        assert (env.transform.states[0]["step_count"] == 1).all()
        td["_reset"] = torch.zeros(NUM_ENVS, 1, dtype=torch.bool)
        td["_reset"][2] = True
        env.reset(td)
        pose = base.get_state()["object_pose"][2]
        torch.testing.assert_close(pose, first["object_pose"], rtol=0, atol=1e-9)


@pytest.mark.usefixtures("env")  # for its constants
def test_objects_with_joints_start_where_they_were(monkeypatch):
    monkeypatch.setattr(starts, "weigh", prefer_moving)
    with torch_panda.make("PandaDrawer-v1", num_envs=NUM_ENVS, seed=0) as base:
        drawer = TransformedEnv(base, StartReached(1.0))
        td = drawer.reset()
        opened = base.get_state()
        opened["object_joint_position"] += 0.05
        base.reset(opened, set_state=True)
        drawer.step(drawer.rand_action(td))
        drawer.reset()
        assert (base.get_state()["object_joint_position"] > 0.02).all()
