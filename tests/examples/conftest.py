"""What the tests of the examples share: evaluations that are quick, demonstrations."""

import signal

import pytest
import torch

import torch_panda
from tests.examples.training.episodes import play
from training import curve
from training.buffers import STORED_KEYS


@pytest.fixture
def make_demos(tmp_path):
    """Write random episodes as an expert's are written."""

    def make(env_id="PandaPush-v1", episodes=4):
        with torch_panda.make(env_id, num_envs=episodes, seed=0) as env:
            data = play(env).select(*STORED_KEYS).reshape(-1)
        path = tmp_path / "demos.pt"
        torch.save(data.to_dict(), path)
        return path

    return make


@pytest.fixture
def quick(monkeypatch):
    """Few episodes an evaluation, and signals and threads as they were."""
    monkeypatch.setattr(curve, "EPISODES", 8)
    monkeypatch.setattr(curve, "NUM_ENVS", 8)
    handlers = {x: signal.getsignal(x) for x in (signal.SIGINT, signal.SIGTERM)}
    threads, precision = torch.get_num_threads(), torch.get_float32_matmul_precision()
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)
    torch.set_num_threads(threads)
    torch.set_float32_matmul_precision(precision)
