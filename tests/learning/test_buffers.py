"""Replay buffers: the episodes that they store, and their hindsight goals."""

import pytest
import torch
from pytest import approx
from tensordict import TensorDict

import torch_panda
from tests.learning.episodes import play_randomly
from torch_panda.learning import buffers
from torch_panda.learning.buffers import has_moved, make_buffer, select_sequences


@pytest.fixture(scope="module")
def stack():
    with torch_panda.make("PandaStack-v1", num_envs=4, seed=0) as env:
        yield env


FUTURE = {"future": 1.0}


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, (FUTURE, 0.8, None)),
        ({"desired_ratio": 0.5}, ({"future": 0.5, "desired": 0.5}, 0.8, None)),
        # All parts are relabelled with probability 0.8. Of these, all get future goals
        # with probability 0.64.
        (
            {"her": "parts", "desired_ratio": 0.36},
            (approx({"future": 0.8, "desired": 0.2}), approx(0.8**0.5), (3, 3)),
        ),
        ({"her": "geometric"}, ({"geometric": 1.0}, 1.0, None)),
    ],
)
def test_each_kind_of_hindsight_has_its_strategy_and_ratio(stack, options, expected):
    """The tests of the transforms show what its options do."""
    buffer = make_buffer(stack, 1000, discount=0.9, **options)
    [hindsight] = buffer._transform.transforms
    assert (hindsight.strategy, hindsight.her_ratio, hindsight.goal_parts) == expected
    assert hindsight.discount == 0.9
    buffer.extend(select_sequences(play_randomly(stack), 1.0).reshape(-1))
    batch = buffer.sample(256)
    goals = batch["next", "achieved_goal"], batch["desired_goal"]
    assert torch.equal(batch["next", "reward"], stack.compute_reward(*goals))


def test_the_reward_of_a_part_ignores_the_other_parts(stack):
    achieved = torch.zeros(4, 6)
    goal = achieved.clone()
    goal[1, 0] = goal[2, 3] = goal[3, 0] = goal[3, 5] = 0.3
    transitions = {
        "desired_goal": goal,
        "next": {"achieved_goal": achieved, "reward": torch.full((4, 1), -1.0)},
    }
    rewards = buffers.PartRewards(stack.compute_reward)(TensorDict(transitions, [4]))
    expected = torch.tensor([[0.0, 0.0], [-1.0, 0.0], [0.0, -1.0], [-1.0, -1.0]])
    assert torch.equal(rewards["next", "reward"], expected)


def test_her_none_keeps_the_goals(stack):
    assert len(make_buffer(stack, 1000, her="none")._transform.transforms) == 0


def test_a_capacity_above_the_buffer_size_is_reduced(stack, monkeypatch):
    monkeypatch.setattr(buffers, "BUFFER_SIZE", 300)
    assert make_buffer(stack, 200)._storage.max_size == 200
    assert make_buffer(stack, 400)._storage.max_size == 300


def test_most_episodes_in_which_nothing_moved_are_left_out(stack):
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


def test_episodes_that_are_cut_end_with_their_sequence(stack):
    data = play_randomly(stack)[:, :3]
    assert not data["next", "done"].any()
    done = select_sequences(data, 1.0)["next", "done"].squeeze(-1)
    assert done.tolist() == [[False, False, True]] * 4


def test_a_movement_in_short_episodes_is_found(stack):
    data = play_randomly(stack)[:, :3]
    goal = data["next", "achieved_goal"]
    goal[:] = goal[:, :1]
    goal[1, 2, 4] += 0.02
    assert has_moved(data).tolist() == [False, True, False, False]
