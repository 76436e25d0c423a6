"""Stable-Baselines3 trains on single and vectorised environments."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from stable_baselines3 import DDPG, HerReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor
from torch.nn.utils import parameters_to_vector

import torch_panda
from torch_panda.gymnasium_envs.sb3 import SB3VecEnv


def make_vectorised():
    return VecMonitor(SB3VecEnv("PandaReach-v1", num_envs=3))


def make_dummy():
    return make_vec_env("torch_panda/PandaReach-v1", n_envs=2)


@pytest.mark.parametrize("make_env", [make_dummy, make_vectorised])
def test_stable_baselines3_trains_with_its_hindsight(make_env):
    env = make_env()
    model = DDPG(
        "MultiInputPolicy",
        env,
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4},
        learning_starts=160,
        batch_size=64,
        policy_kwargs={"net_arch": [32, 32]},
        seed=0,
    )
    before = parameters_to_vector(model.actor.parameters()).detach()
    model.learn(240)
    assert not before.equal(parameters_to_vector(model.actor.parameters()).detach())
    assert len(model.ep_info_buffer) >= 3
    assert len(model.ep_success_buffer) == len(model.ep_info_buffer)
    batch = model.replay_buffer.sample(400)
    achieved_goal = batch.next_observations["achieved_goal"].numpy()
    desired_goal = batch.next_observations["desired_goal"].numpy()
    (expected,) = model.env.env_method(
        "compute_reward", achieved_goal, desired_goal, [], indices=[0]
    )
    assert np.array_equal(batch.rewards.numpy()[:, 0], expected)
    # There are rewards of steps that reached the goal, and of steps that did not.
    assert (expected == 0).any()
    assert (expected == -1).any()
    env.close()


# Success ends episodes of -v3, and the time limit those of -v1.
@pytest.mark.parametrize("env_id", ["PandaReach-v3", "PandaReach-v1"])
def test_values_equal_those_of_dummy_vec_env(env_id):
    ours = SB3VecEnv(env_id, num_envs=3)
    theirs = DummyVecEnv([lambda: gymnasium.make(f"torch_panda/{env_id}")] * 3)
    ours.seed(4)
    theirs.seed(4)
    rng = np.random.default_rng(0)
    observation, expected = ours.reset(), theirs.reset()
    number_of_ends = np.zeros(3)
    for _ in range(60):
        assert data_equivalence(observation, dict(expected), exact=True)
        assert ours.reset_infos == theirs.reset_infos
        towards = observation["desired_goal"] - observation["achieved_goal"]
        action = np.clip(towards * rng.uniform(1, 8), -1, 1).astype(np.float32)
        observation, *rest = ours.step(action)
        expected, *others = theirs.step(action)
        assert data_equivalence(rest, others, exact=True)
        number_of_ends += rest[1]
    ours.close()
    theirs.close()
    assert number_of_ends.min() >= 1


def test_attributes_and_methods_are_those_of_all_environments():
    env = SB3VecEnv("PandaReach-v1", num_envs=3, render_mode="rgb_array")
    assert env.render_mode == "rgb_array"
    assert env.get_attr("num_envs") == [3, 3, 3]
    goals = np.zeros((5, 3)), np.ones((5, 3))
    (reward,) = env.env_method("compute_reward", *goals, [{}], indices=0)
    assert reward.tolist() == [-1] * 5
    env.set_attr("marker", 1)
    assert env.get_attr("marker", [0, 2]) == [1, 1]
    with pytest.raises(ValueError, match="all environments"):
        env.set_attr("marker", 2, indices=1)
    with pytest.raises(AttributeError):
        env.get_attr("speed")
    env.reset()
    env.set_options({"state": {}})
    with pytest.raises(ValueError, match=r"vector_env\.reset"):
        env.reset()
    assert env.env_is_wrapped(gymnasium.Wrapper) == [False] * 3
    env.close()
    with pytest.raises(torch_panda.BulletError, match="closed"):
        env.step(np.zeros((3, 3)))
