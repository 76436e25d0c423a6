"""Long runs do not crash, leak memory, or leave threads and files behind.

A short version runs with all tests; on demand, for hours, the real one:
``pytest -m soak -s tests/test_soak.py``, scaled by ``SOAK_STEPS`` and ``SOAK_CYCLES``.
"""

import gc
import os
import sys
import threading
import time

import numpy as np
import pytest
import torch

import torch_panda

pytestmark = pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="reads memory and threads from /proc"
)
LONG = (pytest.mark.soak, pytest.mark.timeout(0))
STEPS = int(os.environ.get("SOAK_STEPS", 1_000_000))
CYCLES = int(os.environ.get("SOAK_CYCLES", 500))
IDS = (
    "PandaReach-v3",
    "PandaPush-v1",
    "PandaPushJointsDense-v3",
    "PandaSlide-v1",
    "PandaPickAndPlace-v3",
    "PandaStack-v1",
    "PandaStackJoints-v3",
    "PandaFlip-v1",
)


def memory():
    """Memory that this process shares with no other [MB]."""
    with open("/proc/self/status") as status:
        (line,) = (line for line in status if line.startswith("RssAnon"))
    return int(line.split()[1]) / 1024


def left_over():
    """Numbers of threads, of Python and of the system, and of open files."""
    return (
        threading.active_count(),
        len(os.listdir("/proc/self/task")),
        len(os.listdir("/proc/self/fd")),
    )


def random_state(env, rng):
    """A state anywhere near the table: objects may overlap, joints may be bent."""
    state = env.get_state()
    joints = state["joint_position"]
    joints += torch.from_numpy(rng.normal(0, 0.3, joints.shape))
    pose = state["object_pose"]
    if pose.shape[1]:
        pose[..., :2] = torch.from_numpy(rng.uniform(-0.3, 0.3, pose[..., :2].shape))
        pose[..., 2] = torch.from_numpy(rng.uniform(0.0, 0.4, pose.shape[:-1]))
        rotation = torch.from_numpy(rng.normal(size=pose[..., 3:].shape))
        pose[..., 3:] = rotation / rotation.norm(dim=-1, keepdim=True)
        speed = state["object_velocity"]
        speed[:] = torch.from_numpy(rng.normal(0, 3.0, speed.shape))
    keys = [key for key in state.keys() if rng.random() < 0.7]  # noqa: SIM118
    return state.select(*keys)


def random_step(env, td, rng):
    """A step, and often a reset of some environments, to a state or a new episode."""
    scale = rng.choice([0.3, 1.0, 1e30], p=[0.3, 0.6, 0.1])
    shape = env.action_spec.shape
    action = rng.uniform(-1, 1, shape) * scale
    td = env.step(td.set("action", torch.from_numpy(action).float()))["next"]
    assert td["observation"].isfinite().all()
    mask = td["done"] | (torch.from_numpy(rng.random(shape[:1])) < 0.01).unsqueeze(1)
    if not mask.any():
        return td.exclude("reward")
    td["_reset"] = mask
    if rng.random() < 0.3:
        return env.reset(td.update(random_state(env, rng)), set_state=True)
    return env.reset(td)


@pytest.mark.parametrize(
    ("steps", "num_envs"), [(1000, 1), pytest.param(STEPS, 4, marks=LONG)]
)
def test_long_runs_leak_no_memory_threads_or_files(steps, num_envs):
    rng = np.random.default_rng(0)
    gc.collect()
    before = left_over()
    envs = [
        torch_panda.make(env_id, num_envs=num_envs, num_threads=1, seed=0)
        for env_id in IDS
    ]
    tds = [env.reset() for env in envs]
    start, used = time.monotonic(), []
    rounds = steps // num_envs
    for index in range(rounds):
        which = rng.integers(len(envs))
        tds[which] = random_step(envs[which], tds[which], rng)
        if index % max(rounds // 20, 1) == 0:
            used.append(memory())
    used.append(memory())
    seconds = time.monotonic() - start
    for env in envs:
        env.close()
    del envs, env, tds
    gc.collect()
    print(
        f"\n{rounds * num_envs} steps over {num_envs * len(IDS)} environments in "
        f"{seconds:.0f} s; memory [MB]: {', '.join(f'{x:.1f}' for x in used)}"
    )
    assert left_over() == before
    # The first tenth warms up.
    assert used[-1] < 1.01 * used[2]


@pytest.mark.parametrize("cycles", [12, pytest.param(CYCLES, marks=LONG)])
def test_creating_and_closing_environments_leaks_nothing(cycles):
    rng = np.random.default_rng(0)
    used, threads = [], set()
    for index in range(cycles):
        env = torch_panda.make(
            str(rng.choice(torch_panda.ENV_IDS)),
            num_envs=int(rng.integers(1, 4)),
            num_threads=2,
        )
        env.rollout(2)
        env.close()
        del env
        if index % max(cycles // 20, 1) == 0:
            gc.collect()
            used.append(memory())
            threads.add(left_over())
    print(f"\n{cycles} cycles; memory [MB]: {', '.join(f'{x:.1f}' for x in used)}")
    assert len(threads) == 1
    # The first tenth warms up.
    assert used[-1] < 1.01 * used[2]
