"""Environments, buffers and collectors, as the tests of pipelines build them."""

from hypothesis import Phase
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

import torch_panda

# Shrinking a failing example takes minutes, and the examples are short anyway.
PHASES = (Phase.explicit, Phase.reuse, Phase.generate)


def make(env_id="PandaPush-v1", num_envs=4):
    return torch_panda.make(env_id, num_envs=num_envs, seed=0)


def buffer(
    transform,
    *,
    capacity=1000,
    ndim=1,
    storage=None,
    cls=TensorDictReplayBuffer,
    batch_size=64,
    **options,
):
    if storage is None:
        storage = LazyTensorStorage(capacity, ndim=ndim)
    return cls(storage=storage, transform=transform, batch_size=batch_size, **options)


def collect(env, steps=10, batches=3, **options):
    count = env.batch_size.numel() * steps
    return Collector(
        env, frames_per_batch=count, total_frames=count * batches, **options
    )
