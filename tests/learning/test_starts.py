"""Training episodes that start with the hand at an object."""

import functools

import pytest
import torch
from torchrl.envs import TransformedEnv

import torch_panda
from torch_panda.learning.environments.starts import (
    PLACED_KEYS,
    StartFrom,
    states_at_objects,
)

NUM_ENVS = 8


@functools.cache
def make_states(task):
    """The states of a task, which all tests share."""
    number = 32 if task == "Stack" else 16
    return states_at_objects(f"Panda{task}-v1", seed=0, number=number)


@pytest.fixture
def states():
    return make_states("Push")


def start_in(states, env):
    """Start the first environments in these states."""
    return env.reset(states[: env.num_envs].exclude("first_to_goal"), set_state=True)


@pytest.mark.parametrize(
    "task", ["Push", pytest.param("Slide", marks=pytest.mark.slow)]
)
def test_the_hand_starts_beside_an_object_at_rest(task):
    states = make_states(task)
    assert len(states) >= 12
    with torch_panda.make(f"Panda{task}-v1", num_envs=12) as env:
        td = start_in(states, env)
        offset = td["observation"][:, :3] - td["achieved_goal"]
        still = env.step(td.set("action", torch.zeros(12, 3)))["next", "achieved_goal"]
    distance = offset[:, :2].norm(dim=-1)
    assert ((distance > 0.045) & (distance < 0.09)).all()
    assert (offset[:, 2].abs() < 0.01).all()
    quadrants = {(x > 0, y > 0) for x, y in offset[:, :2].tolist()}
    assert len(quadrants) == 4
    torch.testing.assert_close(still, td["achieved_goal"], atol=1e-3, rtol=0)


@pytest.mark.parametrize(
    ("task", "number"),
    [pytest.param("PickAndPlace", 1, marks=pytest.mark.slow), ("Stack", 2)],
)
def test_the_hand_starts_holding_an_object(task, number):
    states = make_states(task)
    assert len(states) >= 12
    with torch_panda.make(f"Panda{task}-v1", num_envs=12) as env:
        td = start_in(states, env)
        before = td["achieved_goal"].unflatten(-1, (number, 3))
        for _ in range(6):
            up = torch.tensor([0.0, 0.0, 0.5, -1.0]).repeat(12, 1)
            td = env.step(td.set("action", up))["next"]
        lifted = td["achieved_goal"].unflatten(-1, (number, 3)) - before
    raised = lifted[..., 2] > 0.05
    first_to_goal = states["first_to_goal"][:12, 0]
    assert first_to_goal.any() == (task == "Stack")
    assert (raised[~first_to_goal].sum(1) == 1).all()
    assert raised.any(0).all()  # every object is held in some state
    assert not raised[first_to_goal][:, :-1].any()
    if first_to_goal.any():
        # In half of these states the last object lies on the table.
        assert 0.3 < raised[first_to_goal, -1].double().mean() < 0.7


def test_the_lower_cube_of_a_stack_can_start_at_its_goal():
    """The lower cube is at its goal in half of the states, and it stays there."""
    states = make_states("Stack")
    with_goal = states[states["first_to_goal"][:, 0]]
    assert 0.4 < len(with_goal) / len(states) < 0.6
    torch.manual_seed(0)
    with torch_panda.make("PandaStack-v1", num_envs=NUM_ENVS, seed=0) as base:
        env = TransformedEnv(base, StartFrom(with_goal, 1.0))
        td = env.reset()
        lower, upper = td["achieved_goal"].split(3, -1)
        goal = td["desired_goal"][:, :3]
        at_goal = (lower - goal).norm(dim=1) < 1e-3
        # The other environments had no room and start as usual.
        assert at_goal.sum() >= NUM_ENVS / 2
        held = upper[:, 2] > 0.1
        assert (at_goal & held).any()
        assert (at_goal & ~held).any()
        for _ in range(10):
            hold = torch.tensor([0.0, 0.0, 0.0, -1.0]).repeat(NUM_ENVS, 1)
            td = env.step(td.set("action", hold))["next"]
            lower, upper = td["achieved_goal"].split(3, -1)
            torch.testing.assert_close(lower[at_goal], goal[at_goal], atol=2e-3, rtol=0)
            assert (upper[at_goal & held, 2] > 0.08).all()
        assert len(goal.unique(dim=0)) == NUM_ENVS


def test_without_room_for_the_object_an_episode_starts_as_usual():
    states = make_states("Stack")
    last_lies = states["object_pose"][:, -1, 2] < 0.1
    lies = states["first_to_goal"][:, 0] & last_lies
    with torch_panda.make("PandaStack-v1", num_envs=1, seed=0) as base:
        goal = base.reset()["desired_goal"][0, :2]
        base.set_seed(0)
        crowded = states[lies][:1].clone()
        crowded["object_pose"][0, -1, :2] = goal.to(crowded["object_pose"])
        td = TransformedEnv(base, StartFrom(crowded, 1.0)).reset()
        base.set_seed(0)
        assert (td["observation"] == base.reset()["observation"]).all()


def test_a_ratio_of_the_episodes_starts_at_an_object(states):
    # In the neutral position the hand is 20 cm high.
    with torch_panda.make("PandaPush-v1", num_envs=NUM_ENVS, seed=0) as base:
        env = TransformedEnv(base, StartFrom(states, 0.3))
        torch.manual_seed(0)
        starts = torch.stack([env.reset() for _ in range(50)])
        low = starts["observation"][..., 2] < 0.1
        assert 0.2 < low.float().mean() < 0.4
        assert low.any(0).all()
        assert not low.all(1).any()
        goals = starts["desired_goal"].flatten(0, 1)
        assert len(goals.unique(dim=0)) == len(goals)
        # They are not the goals that the states were saved with.
        assert (goals[low.flatten()].std(0)[:2] > 0.07).all()
        reached = starts["achieved_goal"][low]
        known = states["object_pose"][:, 0, :3].float()
        torch.testing.assert_close(
            (reached[:, None] - known).abs().amax(-1).amin(1),
            torch.zeros(len(reached)),
        )
        td = env.rollout(3)
        assert td.batch_size == (NUM_ENVS, 3)
        assert not set(PLACED_KEYS) & set(td.keys())


def test_a_partial_reset_starts_only_its_own_at_an_object(states):
    with torch_panda.make("PandaPush-v1", num_envs=NUM_ENVS, seed=0) as base:
        env = TransformedEnv(base, StartFrom(states, 1.0))
        td = env.rollout(3)[:, -1]["next"]
        before = base.get_state()
        td["_reset"] = torch.zeros(NUM_ENVS, 1, dtype=torch.bool)
        td["_reset"][2] = True
        after = env.reset(td)
        state = base.get_state()
        others = torch.arange(NUM_ENVS) != 2
        assert (state[others] == before[others]).all()
        assert (after["observation"][others] == td["observation"][others]).all()
        known = states["joint_position"]
        assert (state["joint_position"][2] == known).all(1).any()
        assert state["step_count"].flatten().tolist() == [3, 3, 0, 3, 3, 3, 3, 3]


@pytest.mark.parametrize("env_id", ["PandaReach-v1", "PandaPushJoints-v1"])
def test_states_at_objects_need_objects_and_end_effector_control(env_id):
    with pytest.raises(ValueError, match=f"end-effector .* got {env_id}"):
        states_at_objects(env_id, seed=0, number=2)


def test_a_hand_that_reaches_no_object_is_an_error(monkeypatch):
    monkeypatch.setattr("torch_panda.learning.environments.starts.SCRIPT_STEPS", 1)
    with pytest.raises(ValueError, match="hand of PandaPush-v1 reaches no object"):
        states_at_objects("PandaPush-v1", seed=0, number=2)
