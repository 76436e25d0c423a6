"""What all tests need."""

import multiprocessing
import signal

import pytest
import torch

import torch_panda


def pytest_configure():
    """Fork worker processes from a server that has imported torchrl once.

    As torchrl's default, "spawn", this sends each worker its functions as pickles.
    """
    multiprocessing.set_start_method("forkserver", force=True)
    multiprocessing.set_forkserver_preload(["torchrl.collectors", "torch_panda.envs"])


@pytest.fixture(autouse=True)
def signals():
    """Ctrl-C raises in every test, whatever handlers the test before it installed.

    A background job of a shell starts with Ctrl-C ignored.
    """
    before = {x: signal.getsignal(x) for x in (signal.SIGINT, signal.SIGTERM)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(autouse=True, scope="session")
def few_starts():
    """Choose the fixed evaluation tasks of every id from few starts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("torch_panda.learning.evaluation.fixed_tasks.NUM_STARTS", 11)
        yield


@pytest.fixture
def make_demos(tmp_path):
    """Write random episodes in the format in which an expert's are written."""
    from tests.learning.episodes import play_randomly
    from torch_panda.learning.buffers import STORED_KEYS

    def make(env_id="PandaPush-v1", episodes=4):
        with torch_panda.make(env_id, num_envs=episodes, seed=0) as env:
            data = play_randomly(env).select(*STORED_KEYS).reshape(-1)
        path = tmp_path / "demos.pt"
        torch.save(data.to_dict(), path)
        return path

    return make


@pytest.fixture
def quick(monkeypatch):
    """Evaluate few episodes, and draw small videos.

    Signal handlers and numbers of threads are restored afterwards.
    """
    from torch_panda.learning.evaluation import curve, video

    monkeypatch.setattr(curve, "EPISODES", 2)
    monkeypatch.setattr(curve, "NUM_ENVS", 2)
    monkeypatch.setattr(video, "CELL", (64, 80))
    threads, precision = torch.get_num_threads(), torch.get_float32_matmul_precision()
    yield
    torch.set_num_threads(threads)
    torch.set_float32_matmul_precision(precision)
