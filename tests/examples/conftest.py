"""What the examples' tests share: a file of demonstrations, if of no expert."""

import pytest
import torch

import torch_panda
from tests.examples.training.episodes import play
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
