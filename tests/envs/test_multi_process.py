"""Threads, seeds and killed workers in multi-process collectors."""

import os
import signal
import time

import pytest
import torch
from parallel import name_dead_workers
from torchrl.collectors import Collector, MultiAsyncCollector, MultiSyncCollector
from torchrl.envs import ParallelEnv, SerialEnv

from tests.envs.multi_process import NUM_ENVS, go_for_the_goal, make_env

STEPS = 5
PATIENCE = 60  # [s], within which a death must be noticed; torchrl's timeout is hours


def kill(process):
    os.kill(process.pid, signal.SIGKILL)
    return process.pid, time.monotonic()


def check_threads(data):
    """Each worker has the given number of stepping threads, and one torch thread."""
    assert (data["next", "threads"] == torch.tensor([2, 1])).all()


def goals(data):
    return {tuple(goal) for goal in data["desired_goal"].reshape(-1, 3).tolist()}


def test_parallel_env_keeps_seeds_and_threads_and_names_a_dead_worker():
    env = ParallelEnv(2, make_env)
    serial = SerialEnv(2, make_env)
    rollouts = []
    for e in (env, serial):
        e.set_seed(0)
        rollouts.append(e.rollout(STEPS, go_for_the_goal))
    serial.close()
    check_threads(rollouts[0])
    # The draws of a worker depend on its seed only, in every run and in any process.
    for key in ("desired_goal", ("next", "observation")):
        assert torch.equal(rollouts[0][key], rollouts[1][key])
    assert len(goals(rollouts[0])) == 2 * NUM_ENVS

    workers = list(env._workers)
    _, start = kill(workers[1])
    named = r"worker 1 (dead|\(exit code -9\)|\(process \d+\) died)"
    for call in (lambda: env.rollout(STEPS), env.close):
        with pytest.raises(RuntimeError, match=named), name_dead_workers(workers):
            call()
    assert time.monotonic() - start < PATIENCE


@pytest.mark.parametrize("collector_class", [MultiSyncCollector, MultiAsyncCollector])
def test_collectors_keep_seeds_and_threads_and_name_a_dead_worker(collector_class):
    frames = 2 * NUM_ENVS * STEPS
    expected = first_goals(seed=0, num_workers=2)
    assert len(expected) == 2 * NUM_ENVS
    collector = collector_class(
        [make_env, make_env],
        go_for_the_goal,
        frames_per_batch=frames,
        total_frames=1000 * frames,
    )
    collector.set_seed(0)
    workers = list(collector.procs)
    seen, killed = set(), None
    with pytest.raises(RuntimeError) as raised, name_dead_workers(workers):
        for data in collector:
            check_threads(data)
            seen.update(goals(data))
            # Both workers drew the same goals as in any other run with this seed.
            if killed is None and expected <= seen:
                killed = kill(workers[1])
    pid, start = killed
    assert time.monotonic() - start < PATIENCE
    assert f"worker 1 (process {pid}) died with exit code -9" in str(raised.value)
    collector.shutdown()
    assert not any(is_alive(worker) for worker in workers)


def first_goals(seed, num_workers):
    """The first goals of the workers under a seed, drawn in this process."""
    drawn = set()
    for _ in range(num_workers):
        collector = Collector(
            make_env, go_for_the_goal, frames_per_batch=NUM_ENVS, total_frames=NUM_ENVS
        )
        seed = collector.set_seed(seed)
        collector.reset()  # multi-process collectors do this when they get a seed
        drawn |= goals(next(iter(collector)))
        collector.shutdown()
    return drawn


def is_alive(process):
    return not process._closed and process.is_alive()
