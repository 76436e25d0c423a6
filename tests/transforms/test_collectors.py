import functools

import pytest
from torchrl.collectors import Collector, MultiAsyncCollector, MultiSyncCollector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from tests.transforms import toy
from tests.transforms.identifiable import check_batch, relabelled, reward_fn
from torch_panda.transforms import HindsightAugment, HindsightRelabel

SINGLE = functools.partial(Collector, toy.make_env)
PARALLEL = functools.partial(Collector, toy.make_parallel)
SYNC = functools.partial(MultiSyncCollector, [toy.make_first, toy.make_second])
ASYNC = functools.partial(MultiAsyncCollector, [toy.make_first, toy.make_second])


def collect(make_collector, frames_per_batch, total_frames, **options):
    collector = make_collector(
        None, frames_per_batch=frames_per_batch, total_frames=total_frames, **options
    )
    try:
        yield from collector
    finally:
        collector.shutdown()


def check(make_collector, frames, total, *, capacity=200, flat=True, **options):
    rb = TensorDictReplayBuffer(
        storage=LazyTensorStorage(capacity, ndim=1 if flat else 2),
        transform=HindsightRelabel(reward_fn),
        batch_size=64,
    )
    share = []
    for data in collect(make_collector, frames, total, **options):
        rb.extend(data.reshape(-1) if flat else data)
        batch = rb.sample()
        check_batch(batch, rb.storage[:], "future")
        share.append(relabelled(batch).float().mean())
    assert abs(sum(share) / len(share) - 0.8) < 0.1


@pytest.mark.parametrize("flat", [True, False])
@pytest.mark.parametrize("reset_at_each_iter", [True, False])
@pytest.mark.parametrize("steps", [1, 2, 5, 17])
def test_single_process(flat, reset_at_each_iter, steps):
    if not flat and steps == 1:
        pytest.skip("TensorDictReplayBuffer cannot write one step of ndim=2 data")
    options = {"flat": flat, "reset_at_each_iter": reset_at_each_iter}
    check(SINGLE, 3 * steps, 3 * steps * 40, **options)


def test_parallel_env():
    check(PARALLEL, 6 * 4, 6 * 4 * 20)


def test_multi_process_synchronous():
    check(SYNC, 6 * 4, 6 * 4 * 20)


def test_multi_process_asynchronous():
    check(ASYNC, 3 * 4, 3 * 4 * 40)


def test_augment_of_a_collectors_data():
    rb = TensorDictReplayBuffer(
        storage=LazyTensorStorage(5000), transform=HindsightAugment(reward_fn, k=2)
    )
    for data in collect(SINGLE, 3 * 5, 3 * 5 * 20):
        rb.extend(data)
    stored = rb.storage[:]
    check_batch(stored, stored, "future")
    assert 3 * (~relabelled(stored)).sum() == len(stored)
