"""One thread at a time: other threads get an error, and nothing crashes.

Two threads in one Bullet client crash the interpreter, so this test runs in a process.
"""

import functools
import gc
import os
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

import torch_panda
from torch_panda.bullet import urdf

THREE_THREADS = """
import threading, torch, torch_panda

env = torch_panda.make("PandaPush-v1", num_envs=4, num_threads=2, seed=0)
start = env.reset()
errors, others = [], []

def step():
    td = start.clone().set("action", torch.ones(4, 3))
    for _ in range(40):
        try:
            env.step(td)
        except torch_panda.BulletError as error:
            errors.append(str(error))
        except BaseException as error:
            others.append(error)

threads = [threading.Thread(target=step) for _ in range(3)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
assert not others, others
assert errors and all("thread" in error for error in errors), errors
assert env.rollout(5).shape == (4, 5)
env.close()
print("fine")
"""


def test_threads_that_step_at_once_get_errors_and_do_no_harm():
    command = [sys.executable, "-c", THREE_THREADS]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.endswith("fine\n"), done.stderr[-2000:]


def test_threads_may_build_environments_of_their_own_at_the_same_time():
    def work(seed):
        with torch_panda.make("PandaPush-v1", num_threads=1, seed=seed) as env:
            data = env.rollout(2, lambda td: td.set("action", torch.ones(3)))
            env.render(size=8)
            return data

    with ThreadPoolExecutor(4) as threads:
        first, *others = threads.map(work, [0, 1, 0, 1, 0, 1])
    assert (others[1] == first).all() and (others[3] == first).all()
    assert not (others[0] == first).all()


def test_threads_share_one_scratch_directory(monkeypatch):
    """All threads use one directory, even if creating it takes long."""

    @functools.cache
    def make_slowly():
        time.sleep(0.1)
        return tempfile.TemporaryDirectory()

    monkeypatch.setattr(urdf, "_process_folder", make_slowly)
    with ThreadPoolExecutor(4) as threads:
        folders = list(threads.map(lambda _: urdf.make_scratch_folder(), range(4)))
    gc.collect()
    assert len({folder.parent for folder in folders}) == 1
    assert all(folder.is_dir() for folder in folders)


@pytest.mark.parametrize("call", ["step", "reset", "render", "get_state", "close"])
def test_every_call_is_refused_while_another_thread_is_inside(monkeypatch, call):
    """The other thread waits inside a step until the call is refused."""
    is_in, may_leave = threading.Event(), threading.Event()
    with torch_panda.make("PandaReach-v1", num_envs=2, num_threads=1, seed=0) as env:
        td = env.reset().set("action", torch.zeros(2, 3))
        calls = {
            "step": lambda: env.step(td.clone()),
            "reset": env.reset,
            "render": lambda: env.render(size=8),
            "get_state": env.get_state,
            "close": env.close,
        }
        observe = env.episodes._observe

        def wait(*arguments):
            is_in.set()
            assert may_leave.wait(60)
            return observe(*arguments)

        monkeypatch.setattr(env.episodes, "_observe", wait)
        thread = threading.Thread(target=env.step, args=(td.clone(),))
        thread.start()
        assert is_in.wait(60)
        with pytest.raises(torch_panda.BulletError, match="thread"):
            calls[call]()
        may_leave.set()
        thread.join()
        calls[call]()


@pytest.mark.parametrize(("num_envs", "num_threads"), [(1, 1), (4, 3)])
def test_the_default_is_one_thread_per_core_that_the_process_may_use(
    monkeypatch, num_envs, num_threads
):
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 5, 9}, raising=False)
    with torch_panda.make("PandaReach-v1", num_envs=num_envs) as env:
        assert env.num_threads == num_threads
