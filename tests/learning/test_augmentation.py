"""Data augmentation: which rows are mirrored and shifted, and how."""

from dataclasses import replace

import pytest
import torch

import torch_panda
from tests.learning.transitions import make_transitions
from torch_panda.learning.agents import Hyperparameters, make_agent
from torch_panda.learning.agents.augmentation import augment, mirror, shift
from torch_panda.learning.agents.batch import Batch
from torch_panda.learning.environments.geometry import read_geometry


@pytest.fixture(scope="module")
def env():
    with torch_panda.make("PandaStack-v1", num_envs=8, seed=0) as env:
        yield env


def play_one_step(env):
    return Batch.from_tensordict(env.rollout(1).reshape(-1))


def test_every_second_row_is_mirrored(env):
    geometry = read_geometry(env)
    rows = play_one_step(env)
    result = mirror(rows, geometry)
    names = {"s": "observation", "g": "goal", "a": "action", "s_next": "observation"}
    for name, quantity in names.items():
        factors = getattr(geometry, quantity)
        now, was = getattr(result, name), getattr(rows, name)
        assert (now[1::2] == was[1::2]).all()
        torch.testing.assert_close(now[::2], was[::2] * torch.tensor(factors))
        assert (now[::2] != was[::2]).any()
    assert result.r is rows.r
    twice = mirror(result, geometry)
    assert all(torch.equal(getattr(twice, x), getattr(rows, x)) for x in names)


def test_half_of_the_rows_are_shifted_along_the_table(env):
    geometry, few = read_geometry(env), play_one_step(env)
    repeated = {x: getattr(few, x).repeat(50, 1) for x in ("s", "s_next", "g")}
    before = few._replace(**repeated)
    torch.manual_seed(0)
    rows = shift(before, geometry, 0.2)
    moved = rows.g - before.g
    some = (moved != 0).any(1)
    assert 0.4 < some.double().mean() < 0.6
    assert (moved[:, [0, 1]].abs().amax(0) > 0.15).all()
    assert (moved[:, [0, 1]].abs() <= 0.2).all()
    torch.testing.assert_close(moved[:, :3], moved[:, 3:])
    assert (moved[:, 2] == 0).all()
    for name in ("s", "s_next"):
        now, was = getattr(rows, name), getattr(before, name)
        assert (now[~some] == was[~some]).all()
        torch.testing.assert_close(
            geometry.differences(now, rows.g), geometry.differences(was, before.g)
        )
        changed = (now != was).any(0).nonzero().flatten()
        assert changed.tolist() == [0, 1, 7, 8, 19, 20]
        torch.testing.assert_close((now - was)[:, :3], moved[:, :3])


def test_objects_are_shifted_in_all_directions_if_a_goal_is_one_number(env):
    geometry, rows = read_geometry(env), play_one_step(env)
    geometry = replace(geometry, goal_positions=())
    torch.manual_seed(0)
    moved = shift(rows._replace(g=rows.g[:, :1]), geometry, 0.2).s - rows.s
    assert (moved[:, 0] - moved[:, 1]).abs().max() > 0.01


@pytest.mark.parametrize("mode", ["none", "mirror", "mirror-shift"])
def test_each_mode_applies_its_augmentations(env, mode):
    geometry, rows = read_geometry(env), play_one_step(env)
    torch.manual_seed(0)
    result = augment(rows, geometry, mode)
    expected = rows if mode == "none" else mirror(rows, geometry)
    torch.manual_seed(0)
    if mode == "mirror-shift":
        expected = shift(expected, geometry, 0.15)
    assert all(map(torch.equal, result[:-2], expected[:-2]))


@pytest.mark.parametrize("learn", ["update", "imitate"])
def test_agents_learn_from_augmented_rows(env, learn):
    batch = make_transitions(env, 8)
    rows = mirror(Batch.from_tensordict(batch), read_geometry(env))
    mirrored = batch.clone()
    mirrored["observation"], mirrored["desired_goal"] = rows.s, rows.g
    mirrored["action"] = rows.a
    mirrored["next", "observation"] = rows.s_next
    results = []
    for augmentation, transitions in (("mirror", batch), ("none", mirrored)):
        torch.manual_seed(0)
        agent = make_agent(env, Hyperparameters(augmentation=augmentation))
        results.append(getattr(agent, learn)(transitions))
    torch.testing.assert_close(*results)
