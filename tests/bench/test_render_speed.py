"""Frames per second beside panda-gym: pytest -m slow -s <this file>."""

import statistics
import time

import gymnasium
import numpy as np
import pytest
import torch

import torch_panda

pytestmark = pytest.mark.slow
NUM_ENVS = 16
NUM_THREADS = 2
STEPS = 4
ROUNDS = 5


def make_panda_gym_env(size):
    import panda_gym  # noqa: F401 (registers the environments)

    env = gymnasium.make(
        "PandaPush-v3",
        render_mode="rgb_array",
        renderer="Tiny",
        render_width=size,
        render_height=size,
    )
    return gymnasium.wrappers.AddRenderObservation(env, render_only=True)


@pytest.mark.parametrize("size", [64, 128])
def test_faster_than_panda_gym(size):
    rng = np.random.default_rng(0)
    ours = torch_panda.make(
        "PandaPush-v3",
        num_envs=NUM_ENVS,
        num_threads=NUM_THREADS,
        seed=0,
        from_pixels=True,
        render_size=size,
    )
    theirs = gymnasium.vector.AsyncVectorEnv(
        [lambda: make_panda_gym_env(size)] * NUM_ENVS
    )
    td = ours.reset()
    theirs.reset(seed=0)

    def draw_actions():
        return rng.uniform(-1, 1, size=(NUM_ENVS, 3)).astype(np.float32)

    def step_ours():
        nonlocal td
        _, td = ours.step_and_maybe_reset(
            td.set("action", torch.from_numpy(draw_actions()))
        )
        return td["pixels"]

    def step_theirs():
        return theirs.step(draw_actions())[0]

    speeds = {step_ours: [], step_theirs: []}
    for _ in range(ROUNDS + 1):
        for step, values in speeds.items():
            start = time.perf_counter()
            for _ in range(STEPS):
                pixels = step()
            values.append(NUM_ENVS * STEPS / (time.perf_counter() - start))
            assert pixels.shape == (NUM_ENVS, size, size, 3)
    ours.close()
    theirs.close()
    ratios = [a / b for a, b in zip(*speeds.values(), strict=True)][1:]
    for name, values in zip(("torch_panda", "panda-gym"), speeds.values(), strict=True):
        print(
            f"{name} at {size} x {size}: {statistics.median(values[1:]):.0f} frames/s "
            f"({min(values[1:]):.0f} to {max(values[1:]):.0f})"
        )
    print(f"ratio: {statistics.median(ratios):.2f}")
    assert statistics.median(ratios) > 1.5
