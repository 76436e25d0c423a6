"""`SB3VecEnv` returns the same values as DummyVecEnv."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from stable_baselines3.common.vec_env import DummyVecEnv

import torch_panda
from torch_panda.gymnasium_envs.sb3 import SB3VecEnv


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
    with pytest.raises(ValueError, match=r"vector_env\.reset"):
        env.set_options({"state": {}})
    env.reset()
    assert env.env_is_wrapped(gymnasium.Wrapper) == [False] * 3
    env.close()
    with pytest.raises(torch_panda.BulletError, match="closed"):
        env.step(np.zeros((3, 3)))
