"""Steps per second beside panda-gym: pytest -m slow -s tests/test_speed.py."""

import statistics
import time

import gymnasium
import numpy as np
import panda_gym
import pytest
import torch
from torchrl.envs import GymEnv, ParallelEnv

import torch_panda

pytestmark = pytest.mark.slow
NUM_ENVS = 16
STEPS = 50
ROUNDS = 5


def make_gym_env():
    return gymnasium.make(f"PandaPush-v{panda_gym.__version__[0]}")


def make_torchrl_env():
    return GymEnv(f"PandaPush-v{panda_gym.__version__[0]}")


def time_steps(step):
    start = time.perf_counter()
    for _ in range(STEPS):
        step()
    return NUM_ENVS * STEPS / (time.perf_counter() - start)


def test_faster_than_panda_gym():
    rng = np.random.default_rng(0)
    ours = torch_panda.make("PandaPush-v3", num_envs=NUM_ENVS, seed=0)
    gym_env = gymnasium.vector.AsyncVectorEnv([make_gym_env] * NUM_ENVS)
    parallel = ParallelEnv(NUM_ENVS, make_torchrl_env, mp_start_method="spawn")
    state = {"ours": ours.reset(), "parallel": parallel.reset()}
    gym_env.reset(seed=0)

    def step_torchrl(name, env):
        td = state[name]
        action = rng.uniform(-1, 1, size=(NUM_ENVS, 3)).astype(np.float32)
        td["action"] = torch.from_numpy(action)
        _, state[name] = env.step_and_maybe_reset(td)

    steps = {
        "torch_panda": lambda: step_torchrl("ours", ours),
        "AsyncVectorEnv": lambda: gym_env.step(
            rng.uniform(-1, 1, size=(NUM_ENVS, 3)).astype(np.float32)
        ),
        "ParallelEnv": lambda: step_torchrl("parallel", parallel),
    }
    speeds = {name: [] for name in steps}
    for _ in range(ROUNDS + 1):
        for name, step in steps.items():
            speeds[name].append(time_steps(step))
    for env in (ours, gym_env, parallel):
        env.close()
    medians = {name: statistics.median(values[1:]) for name, values in speeds.items()}
    for name, values in speeds.items():
        low, high = min(values[1:]), max(values[1:])
        print(f"{name}: {medians[name]:.0f} steps/s ({low:.0f} to {high:.0f})")
    assert medians["torch_panda"] > 1.25 * medians["AsyncVectorEnv"]
    assert medians["torch_panda"] > 1.8 * medians["ParallelEnv"]


def test_creation_and_reset():
    start = time.perf_counter()
    env = torch_panda.make("PandaPush-v3", num_envs=64, num_threads=1)
    creation = time.perf_counter() - start
    env.reset()
    start = time.perf_counter()
    for _ in range(20):
        env.reset()
    reset = (time.perf_counter() - start) / (20 * 64)
    env.close()
    print(f"64 environments: {creation:.2f} s; a reset: {reset * 1e3:.3f} ms")
    assert creation < 6.0
    assert reset < 0.4e-3
