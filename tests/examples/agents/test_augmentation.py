"""Transitions that are mirrored and moved: which rows, and how."""

import pytest
import torch

import torch_panda
from agents.augmentation import SHIFT, Augmentation, mirror, shift, swap
from agents.geometry import read_geometry
from agents.transitions import Transitions


@pytest.fixture(scope="module")
def env():
    with torch_panda.make("PandaStack-v1", num_envs=8, seed=0) as env:
        yield env


def transitions(env):
    return Transitions.from_tensordict(env.rollout(1).reshape(-1))


def test_every_second_row_is_mirrored(env):
    geometry = read_geometry(env)
    rows = transitions(env)
    found = mirror(rows, geometry)
    names = ("observation", "goal", "action", "next_observation")
    for name in names:
        factors = getattr(geometry, name.removeprefix("next_"))
        now, was = getattr(found, name), getattr(rows, name)
        assert (now[1::2] == was[1::2]).all()
        torch.testing.assert_close(now[::2], was[::2] * torch.tensor(factors))
        assert (now[::2] != was[::2]).any()
    assert found.reward is rows.reward
    twice = mirror(found, geometry)
    assert all(torch.equal(getattr(twice, x), getattr(rows, x)) for x in names)


def test_shift(env):
    geometry, few = read_geometry(env), transitions(env)
    before = Transitions(*(x.repeat(50, *[1] * (x.ndim - 1)) for x in few))
    torch.manual_seed(0)
    rows = shift(before, geometry, 0.2)
    moved = rows.goal - before.goal
    some = (moved != 0).any(1)
    assert 0.4 < some.double().mean() < 0.6
    assert (moved[:, [0, 1]].abs().amax(0) > 0.15).all()
    assert (moved[:, [0, 1]].abs() <= 0.2).all()
    torch.testing.assert_close(moved[:, :3], moved[:, 3:])
    assert (moved[:, 2] == 0).all()
    for name in ("observation", "next_observation"):
        now, was = getattr(rows, name), getattr(before, name)
        assert (now[~some] == was[~some]).all()
        torch.testing.assert_close(
            geometry.differences(now, rows.goal), geometry.differences(was, before.goal)
        )
        changed = (now != was).any(0).nonzero().flatten()
        assert changed.tolist() == [0, 1, 7, 8, 19, 20]
        torch.testing.assert_close((now - was)[:, :3], moved[:, :3])


def test_exchanged_cubes_fall_and_turn_as_in_an_episode_that_began_so():
    """In the air above the arm: half of the rows are as the other world's, all bits."""
    with torch_panda.make("PandaStack-v1", num_envs=2, seed=0) as env:
        geometry = read_geometry(env)
        state = env.reset().update(env.get_state())
        state["object_pose"][0, :, 2] += torch.tensor([20.0, 25.0])
        state["object_velocity"][0, 1] = 1.0
        for key in ("object_pose", "object_velocity"):
            state[key][1] = state[key][0].flip(0)
        state["desired_goal"][1] = state["desired_goal"][0].roll(3)
        td = env.reset(state, set_state=True)
        action = torch.full((2, 4), 0.1)
        rows = Transitions.from_tensordict(env.step(td.set("action", action)))
    many = Transitions(*(x[:1].repeat(200, 1) for x in rows))
    torch.manual_seed(0)
    found = swap(many, geometry)
    some = (found.goal != many.goal).any(1)
    assert 0.4 < some.double().mean() < 0.6
    for now, (first, second) in zip(found, rows, strict=True):
        assert (now[~some] == first).all()
        assert (now[some] == second).all()


@pytest.mark.parametrize(
    "kind", ["none", "mirror", "mirror-shift", "mirror-shift-swap"]
)
def test_kinds(env, kind):
    geometry, rows = read_geometry(env), transitions(env)
    torch.manual_seed(0)
    found = Augmentation(geometry, kind)(rows)
    expected = rows if kind == "none" else mirror(rows, geometry)
    torch.manual_seed(0)
    if kind.startswith("mirror-shift"):
        expected = shift(expected, geometry, SHIFT)
    if kind == "mirror-shift-swap":
        expected = swap(expected, geometry)
    assert all(map(torch.equal, found, expected))


def test_joint_control_has_no_mirror():
    with torch_panda.make("PandaPushJoints-v1", num_envs=1) as env:
        geometry = read_geometry(env)
    with pytest.raises(ValueError, match="pass --augmentation none"):
        Augmentation(geometry, "mirror")
    Augmentation(geometry, "none")


def test_one_object_has_no_other_to_be_exchanged_with():
    with torch_panda.make("PandaPush-v1", num_envs=1) as env:
        geometry = read_geometry(env)
    with pytest.raises(ValueError, match="two equal objects"):
        Augmentation(geometry, "mirror-shift-swap")
