"""Steps per second, memory and creation: pytest -m slow -s <this file>."""

import statistics
import subprocess
import sys
import time

import gymnasium
import numpy as np
import pytest
import torch
from torchrl.envs import GymEnv, ParallelEnv

import torch_panda
from tests.bench.panda_gym_push import PUSH, make_push
from torch_panda.bench.contenders import CONTENDERS, OURS
from torch_panda.bench.stepping import Setting
from torch_panda.bullet.native import LIBRARY

pytestmark = pytest.mark.slow
NUM_ENVS = 16
STEPS = 50
ROUNDS = 5


def make_torchrl_env():
    return GymEnv(PUSH)


def time_steps(step, steps=STEPS):
    start = time.perf_counter()
    for _ in range(steps):
        step()
    return NUM_ENVS * steps / (time.perf_counter() - start)


def test_faster_than_panda_gym():
    rng = np.random.default_rng(0)
    ours = torch_panda.make("PandaPush-v3", num_envs=NUM_ENVS, seed=0)
    gym_env = gymnasium.vector.AsyncVectorEnv([make_push] * NUM_ENVS)
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


@pytest.mark.skipif(LIBRARY is None, reason="the native loop was not compiled")
def test_close_to_bare_bullet():
    """At least 0.90 of the loop with nothing between its steps."""
    setting, steps, pairs = Setting("PandaPush-v3", NUM_ENVS, num_threads=2), 200, 7
    contenders = [CONTENDERS[name].make(setting) for name in (OURS, "bare-bullet")]
    ratios = []
    for _ in range(1 + pairs):
        ours, bare = (c.measure(NUM_ENVS, steps).per_second for c in contenders)
        ratios.append(ours / bare)
        print(f"torch_panda: {ours:.0f}, bare Bullet: {bare:.0f} steps/s")
    for contender in contenders:
        contender.close()
    ratios = ratios[1:]
    ratio = statistics.median(ratios)
    print(f"ratio: {ratio:.3f} ({min(ratios):.3f} to {max(ratios):.3f})")
    assert ratio >= 0.90


# Prints the growth of the resident memory per environment [KiB].
MEASURE_MEMORY = """
from pathlib import Path
import torch_panda

def resident():
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmRSS")).split()[1])

first = torch_panda.make("PandaPush-v3", num_envs=1, num_threads=1)
first.reset()
before = resident()
others = torch_panda.make("PandaPush-v3", num_envs=64, num_threads=1)
others.reset()
print((resident() - before) / 64)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_memory_per_environment():
    command = (sys.executable, "-c", MEASURE_MEMORY)
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    megabytes = float(done.stdout) * 1024 / 1e6
    print(f"an environment: {megabytes:.1f} MB")
    assert 10.0 < megabytes < 45.0
