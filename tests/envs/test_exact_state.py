"""After a reset to an exact state, episodes continue bit for bit."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict

import torch_panda
from tests.envs.test_parity import choose_actions
from torch_panda.envs import exact_states

NUM_ENVS = 4


def act(env, td, env_id, rngs, steps):
    size = env.action_spec.shape[-1]
    for _ in range(steps):
        action = choose_actions(env_id, td["observation"], rngs, size)
        td = env.step(td.set("action", action))["next"]
    return td


def follow(env, td, actions):
    observations = []
    for action in actions:
        td = env.step(td.clone().set("action", action))["next"]
        observations.append(td)
    return torch.stack(observations, dim=1)


@pytest.mark.parametrize(
    "env_id",
    ["PandaPush-v1", "PandaSlideJoints-v3", "PandaPickAndPlace-v1", "PandaStack-v3"],
)
def test_an_episode_continues_bit_for_bit(env_id):
    """The environments have hard contacts and have taken different numbers of steps."""
    rngs = [np.random.default_rng(k) for k in range(NUM_ENVS)]
    with torch_panda.make(env_id, num_envs=NUM_ENVS, num_threads=2, seed=1) as env:
        td = act(env, env.reset(), env_id, rngs, 12)
        half = torch.tensor([[True], [False]] * (NUM_ENVS // 2))
        td = act(env, env.reset(td.set("_reset", half)), env_id, rngs, 9)
        state = env.get_state(exact=True)
        assert state["num_actions"].flatten().tolist() == [9, 21] * (NUM_ENVS // 2)
        generator = torch.Generator().manual_seed(0)
        shape = (20, *env.action_spec.shape)
        actions = torch.randn(shape, generator=generator).clamp(-1, 1)
        expected = follow(env, td.clone(), actions)
        act(env, env.reset(), env_id, rngs, 5)
        again = env.reset(state, set_state=True)
        for key in ("observation", "achieved_goal", "desired_goal", "success"):
            assert torch.equal(again[key], td[key]), key
        assert (env.get_state(exact=True) == state).all()
        assert (follow(env, again, actions) == expected).all()
    # Continue the episode in another environment, too.
    with torch_panda.make(env_id, num_envs=NUM_ENVS, num_threads=1) as other:
        again = other.reset(state.clone(), set_state=True)
        assert (follow(other, again, actions) == expected).all()


def test_an_exact_state_may_have_no_actions_and_no_batch():
    with torch_panda.make("PandaPush-v1", seed=0, sensors=("joint_torque",)) as env:
        first = env.reset()
        state = env.get_state(exact=True)
        assert state["actions"].shape == (0, 3)
        action = torch.tensor([1.0, 0.0, -1.0])
        expected = env.step(first.clone().set("action", action))["next"]
        later = env.get_state(exact=True)
        again = env.reset(state, set_state=True)
        actual = env.step(again.set("action", action))["next"]
        assert (actual == expected).all()
        # Sensors have the same readings as before, not those of a start.
        again = env.reset(later, set_state=True)
        assert torch.equal(again["joint_torque"], expected["joint_torque"])


def test_a_partial_reset_to_an_exact_state_restores_only_its_own():
    with torch_panda.make("PandaPush-v1", num_envs=2, seed=0) as env:
        torch.manual_seed(0)
        td = env.rollout(5)[:, -1]["next"].exclude("reward")
        mask = torch.tensor([True, False])
        env.step(td.clone().set("action", torch.ones(2, 3)).set("_step", mask))
        mask[:] = True  # the history must have its own copy of the mask
        state = env.get_state(exact=True)
        assert state["num_actions"].flatten().tolist() == [6, 5]
        action = torch.ones(2, 3)
        expected = env.step(td.clone().set("action", action))["next"]
        state["_reset"] = torch.tensor([[False], [True]])
        env.reset(state, set_state=True)
        assert env.get_state()["step_count"].flatten().tolist() == [7, 5]
        env.step(td.clone().set("action", action).set("_step", state["_reset"][:, 0]))
        pose = env.get_state()["object_pose"][1, 0, :3].float()
        assert torch.equal(pose, expected["achieved_goal"][1])


def test_a_reset_of_no_environment_to_an_exact_state_changes_nothing():
    with torch_panda.make("PandaReach-v1", num_envs=2, seed=0) as env:
        td = env.step(env.reset().set("action", torch.ones(2, 3)))["next"]
        state = env.get_state(exact=True).set("_reset", torch.zeros(2, 1) > 0)
        same = env.reset(state, set_state=True)
        assert torch.equal(same["observation"], td["observation"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.exclude("actions"), r"needs all its entries.*'actions'"),
        (lambda s: s.exclude("joint_position"), r"needs all.*'joint_position'"),
        (lambda s: s.set("actions", s["actions"] * 9), r"actions of environment 0"),
        (lambda s: s.set("actions", s["actions"][..., :2]), "actions must have shape"),
        (lambda s: s.set("actions", s["actions"][:, 0, 0]), "actions must have shape"),
        (lambda s: s.set("num_actions", s["num_actions"] + 1), "at most 3"),
        (
            lambda s: s.set("object_pose", s["object_pose"] + 1e-9),
            "environment 0 do not lead to its object_pose",
        ),
    ],
)
def test_a_wrong_exact_state_is_refused(change, message):
    with torch_panda.make("PandaPush-v1", num_envs=2, seed=0) as env:
        torch.manual_seed(0)
        env.rollout(3)
        state = env.get_state(exact=True)
        with pytest.raises(ValueError, match=message):
            env.reset(change(state.clone()), set_state=True)
        env.rollout(3)


def test_an_episode_whose_action_scale_changes_has_no_exact_state():
    with torch_panda.make("PandaPush-v1", num_envs=2, seed=0) as env:
        td = env.reset().set("action", torch.ones(2, 3))
        env.robot.action_scale = 0.03
        env.step(td.clone())
        state = env.get_state(exact=True)
        env.robot.action_scale = 0.04
        with pytest.raises(torch_panda.BulletError, match=r"from 0.03 to 0.04 .*0, 1"):
            env.get_state(exact=True)
        env.reset()
        env.get_state(exact=True)
        env.robot.action_scale = 0.03
        env.reset(state, set_state=True)


def test_episodes_without_end_are_forgotten(monkeypatch):
    monkeypatch.setattr(exact_states, "_MAX_STEPS", 10)
    with torch_panda.make("PandaReach-v1", num_envs=2, seed=0) as env:
        td = env.reset().set("action", torch.zeros(2, 3))
        for _ in range(10):
            env.step(td.clone())
        assert env.get_state(exact=True)["actions"].shape == (2, 10, 3)
        env.step(td.clone())
        with pytest.raises(torch_panda.BulletError, match=r"\[0, 1\] are too long"):
            env.get_state(exact=True)
        env.reset()
        env.step(td.clone())
        assert env.get_state(exact=True)["actions"].shape == (2, 1, 3)


def test_an_endless_episode_does_not_cost_the_others_their_exact_states(monkeypatch):
    monkeypatch.setattr(exact_states, "_MAX_STEPS", 10)
    with torch_panda.make("PandaReach-v1", num_envs=2, seed=0) as env:
        td = env.reset().set("action", torch.zeros(2, 3))
        for step in range(12):
            if step == 8:
                env.reset(TensorDict({"_reset": torch.tensor([[False], [True]])}, [2]))
            env.step(td.clone())
        with pytest.raises(torch_panda.BulletError, match=r"environments \[0\] are"):
            env.get_state(exact=True)
        env.reset(TensorDict({"_reset": torch.tensor([[True], [False]])}, [2]))
        assert env.get_state(exact=True)["num_actions"].tolist() == [[0], [4]]


def test_long_histories_are_forgotten_with_their_episodes():
    with torch_panda.make(
        "PandaReach-v1", num_envs=2, num_threads=1, seed=0, physics="fast"
    ) as env:
        torch.manual_seed(0)
        env.rollout(1101, break_when_any_done=False)
        assert len(env.episodes._exact_states._steps) < 1100
        state = env.get_state(exact=True)
        assert state["num_actions"].flatten().tolist() == [1, 1]
