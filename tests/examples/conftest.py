"""What the examples' tests share: a file of demonstrations, if of no expert."""

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs.utils import RandomPolicy

import torch_panda
from training.buffers import STORED_KEYS


@pytest.fixture
def make_demos(tmp_path):
    """Write random episodes as record_demos.py writes an expert's."""

    def make(env_id="PandaPush-v1", episodes=4):
        env = torch_panda.make(env_id, num_envs=episodes, seed=0)
        torch.manual_seed(0)
        data = next(
            iter(Collector(env, RandomPolicy(env.action_spec), frames_per_batch=200))
        )
        path = tmp_path / "demos.pt"
        torch.save(data.select(*STORED_KEYS).reshape(-1).to_dict(), path)
        env.close()
        return path

    return make
