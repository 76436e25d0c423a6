"""Collection with Stable-Baselines3, ours and panda-gym's environments in turn.

``OMP_NUM_THREADS=1 pytest -m slow -s tests/gymnasium_envs/test_sb3_speed.py``
"""

import statistics
import time

import gymnasium
import panda_gym
import pytest
from stable_baselines3 import DDPG, HerReplayBuffer
from stable_baselines3.common.vec_env import SubprocVecEnv

from torch_panda.gymnasium_envs.sb3 import SB3VecEnv

pytestmark = pytest.mark.slow
NUM_ENVS = 16
STEPS = 100
ROUNDS = 5


def make_panda_gym():
    return gymnasium.make(f"PandaPush-v{panda_gym.__version__[0]}")


def make_model(env):
    """Acts with its policy and stores, but takes no gradient steps."""
    return DDPG(
        "MultiInputPolicy",
        env,
        replay_buffer_class=HerReplayBuffer,
        learning_starts=0,
        gradient_steps=0,
    )


def time_collection(model):
    start = time.perf_counter()
    model.learn(NUM_ENVS * STEPS, reset_num_timesteps=False)
    return NUM_ENVS * STEPS / (time.perf_counter() - start)


def test_faster_than_panda_gym_in_processes():
    envs = {
        "SB3VecEnv": SB3VecEnv("PandaPush-v3", num_envs=NUM_ENVS),
        "SubprocVecEnv of panda-gym": SubprocVecEnv([make_panda_gym] * NUM_ENVS),
    }
    models = {name: make_model(env) for name, env in envs.items()}
    speeds = {name: [] for name in envs}
    for _ in range(ROUNDS + 1):
        for name, model in models.items():
            speeds[name].append(time_collection(model))
    for env in envs.values():
        env.close()
    medians = {}
    for name, (_, *values) in speeds.items():
        medians[name] = statistics.median(values)
        print(
            f"{name}: {medians[name]:.0f} steps/s "
            f"({min(values):.0f} to {max(values):.0f})"
        )
    ours, theirs = medians.values()
    print(f"ratio: {ours / theirs:.2f}")
    assert ours > 1.2 * theirs
