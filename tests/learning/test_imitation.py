"""Imitation of demonstrations before reinforcement learning."""

import pytest
import torch
from tensordict import TensorDict

from torch_panda.learning.options import Args
from torch_panda.learning.training import Run


@pytest.mark.usefixtures("quick")
def test_the_learning_rate_of_imitation_falls_to_0(tmp_path, make_demos):
    """Reinforcement learning then starts with the usual learning rate."""
    demos = TensorDict(torch.load(make_demos("PandaReach-v1"))).auto_batch_size_(1)
    run = Run(Args(num_envs=1, total_steps=0, pretrain_updates=4), tmp_path, demos)
    rates, imitate = [], run.agent.imitate
    (group,) = run.agent.optimizer.param_groups
    run.agent.imitate = lambda batch: rates.append(group["lr"]) or imitate(batch)
    assert run.train()
    run.close()
    assert rates == pytest.approx([1e-3, 7.5e-4, 5e-4, 2.5e-4])
    assert group["lr"] == 1e-3
    assert run.progress.pretrained == 4
    assert [row["updates"] for row in run.progress.curve] == [0, 0]
