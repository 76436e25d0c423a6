"""What all tests need."""

import signal

import pytest
import torch

import torch_panda
from torch_panda.bullet import native


@pytest.fixture(scope="session", autouse=True)
def interrupts():
    """Ctrl-C raises, also where a shell's background job started with it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(params=["native", "ctypes"])
def loop(request, monkeypatch):
    """Steps through either loop: whatever a test finds must hold for both."""
    if request.param == "native" and native.LIBRARY is None:
        pytest.skip("installed where there was no C compiler")
    monkeypatch.setenv(native.LOOP_VARIABLE, request.param)
    return request.param


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
    """Evaluate few episodes and draw small videos.

    Signal handlers and numbers of threads are restored afterwards.
    """
    from torch_panda.learning import curve, video

    monkeypatch.setattr(curve, "EPISODES", 8)
    monkeypatch.setattr(curve, "NUM_ENVS", 8)
    monkeypatch.setattr(video, "CELL", (64, 80))
    handlers = {x: signal.getsignal(x) for x in (signal.SIGINT, signal.SIGTERM)}
    threads, precision = torch.get_num_threads(), torch.get_float32_matmul_precision()
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)
    torch.set_num_threads(threads)
    torch.set_float32_matmul_precision(precision)
