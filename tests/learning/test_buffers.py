"""Replay buffers: the episodes that they store, and their hindsight goals."""

import pytest
import torch

import torch_panda
from tests.learning.episodes import play_randomly
from torch_panda.learning import buffers
from torch_panda.learning.buffers import has_moved, make_buffer, select_sequences


@pytest.fixture(scope="module")
def stack():
    with torch_panda.make("PandaStack-v1", num_envs=4, seed=0) as env:
        yield env


def relabelled(batch, own):
    """Whether the goal differs from the episode's original goal, by row and object."""
    goal = batch["desired_goal"].unflatten(-1, (2, 3))
    episode = batch["collector", "traj_ids"]
    return (goal != own[episode].unflatten(-1, (2, 3))).any(-1)


@pytest.mark.parametrize(
    ("her", "expected"),
    [
        ("none", (0.0, 0.0, 0.0)),
        ("relabel", (0.0, 0.0, 0.8)),
        ("parts", (0.16, 0.16, 0.64)),
    ],
)
def test_kinds_of_hindsight(stack, her, expected):
    """Fractions of rows: first object relabelled, second relabelled, both."""
    data = play_randomly(stack)
    own = data["desired_goal"][:, 0]
    buffer = make_buffer(stack, 1000, her=her, seed=0)
    buffer.extend(select_sequences(data, 1.0).reshape(-1))
    first, second = relabelled(buffer.sample(4000), own).T
    result = [first & ~second, second & ~first, first & second]
    # Hindsight goals equal achieved goals, which never equal the original ones here.
    result = [float(x.double().mean()) for x in result]
    assert result == pytest.approx(expected, abs=0.03)


def test_desired_goals_of_others(stack):
    data = play_randomly(stack)
    own = data["desired_goal"][:, 0]
    buffer = make_buffer(stack, 1000, desired_ratio=0.5, seed=0)
    buffer.extend(select_sequences(data, 1.0).reshape(-1))
    batch = buffer.sample(4000)
    goal, episode = batch["desired_goal"], batch["collector", "traj_ids"]
    is_desired = (goal[:, None] == own).all(-1)
    others = is_desired.any(1) & ~is_desired.gather(1, episode[:, None])[:, 0]
    # A quarter of the drawn goals are those that the rows have already.
    assert abs(others.double().mean() - 0.4 * 0.75) < 0.04
    reward = stack.compute_reward(batch["next", "achieved_goal"], goal)
    torch.testing.assert_close(batch["next", "reward"], reward)


def test_geometric_goals():
    """Every goal is achieved k steps later, with probability in proportion to 0.9^k."""
    with torch_panda.make("PandaReach-v1", num_envs=4, seed=0) as env:
        data = play_randomly(env)
        buffer = make_buffer(env, 1000, her="geometric", discount=0.9, seed=0)
    buffer.extend(select_sequences(data, 1.0).reshape(-1))
    batch = buffer.sample(4000)
    achieved = data["next", "achieved_goal"].flatten(0, 1)
    is_goal = (batch["desired_goal"][:, None] == achieved).all(-1)
    assert (is_goal.sum(1) == 1).all()
    k = is_goal.long().argmax(1) - batch["index"]
    steps_left = data.shape[1] - batch["index"] % data.shape[1]
    assert ((k >= 0) & (k < steps_left)).all()
    later = torch.arange(data.shape[1])
    weights = torch.where(later < steps_left[:, None], 0.9**later, 0.0)
    expected = (weights / weights.sum(1, keepdim=True)).sum(0)
    drawn = torch.bincount(k, minlength=len(later))
    torch.testing.assert_close(
        drawn.cumsum(0) / 4000, expected.cumsum(0) / 4000, atol=0.03, rtol=0.0
    )


def test_parts_need_several_objects():
    with (
        torch_panda.make("PandaPush-v1", num_envs=1) as env,
        pytest.raises(ValueError, match="goals of several objects"),
    ):
        make_buffer(env, 100, her="parts")


def test_capacity(stack, monkeypatch):
    monkeypatch.setattr(buffers, "BUFFER_SIZE", 300)
    assert make_buffer(stack, 200)._storage.max_size == 200
    assert make_buffer(stack, 400)._storage.max_size == 300


def test_episodes_in_which_nothing_moved(stack):
    data = play_randomly(stack)
    goal = data["next", "achieved_goal"]
    goal[:] = goal[:, :1]
    goal[1, 60:, 4] += 0.02
    goal[2, :3, 2] += 0.05  # before the objects have settled
    assert has_moved(data).tolist() == [False, True, False, False]
    torch.manual_seed(0)
    kept = [len(select_sequences(data.clone(), 0.25)) for _ in range(200)]
    assert abs(sum(kept) / 200 - (1 + 3 / 4)) < 0.2
    assert len(select_sequences(data, 1.0)) == 4
    assert data["next", "done"][:, -1].all()


def test_short_episodes_in_which_something_moved(stack):
    data = play_randomly(stack)[:, :3]
    goal = data["next", "achieved_goal"]
    goal[:] = goal[:, :1]
    goal[1, 2, 4] += 0.02
    assert has_moved(data).tolist() == [False, True, False, False]
