import functools

import pytest
from torchrl.collectors import Collector, MultiAsyncCollector, MultiSyncCollector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from tests.transforms import panda, toy
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


@pytest.mark.parametrize("hindsight", [HindsightRelabel, HindsightAugment])
def test_collectors_in_turn(hindsight):
    """Each numbers its trajectories from 0 and leaves some unfinished."""
    rb = TensorDictReplayBuffer(
        storage=LazyTensorStorage(5000), transform=hindsight(reward_fn), batch_size=256
    )
    for make in (toy.make_first, toy.make_second, toy.make_env):
        for data in collect(functools.partial(Collector, make), 3 * 5, 3 * 5 * 4):
            rb.extend(data.reshape(-1))
    check_batch(rb.sample(), rb.storage[:], "future")


@pytest.mark.slow
def test_parallel_env():
    check(PARALLEL, 6 * 4, 6 * 4 * 20)


@pytest.mark.slow
def test_multi_process_synchronous():
    check(SYNC, 6 * 4, 6 * 4 * 20)


@pytest.mark.slow
def test_multi_process_asynchronous():
    check(ASYNC, 3 * 4, 3 * 4 * 40)


PANDAS = {
    "batched": functools.partial(Collector, panda.make_env),
    "ParallelEnv": functools.partial(Collector, panda.make_parallel),
    "synchronous": functools.partial(
        MultiSyncCollector, [panda.make_env, panda.make_longer]
    ),
    "asynchronous": functools.partial(
        MultiAsyncCollector, [panda.make_env, panda.make_longer]
    ),
}
PANDAS_NESTED = {
    "synchronous": functools.partial(MultiSyncCollector, [panda.make_parallel] * 2),
    "asynchronous": functools.partial(MultiAsyncCollector, [panda.make_parallel] * 2),
}


@pytest.mark.parametrize("collector", PANDAS)
def test_panda_environments(collector):
    check_panda(PANDAS[collector])


@pytest.mark.slow
@pytest.mark.parametrize("collector", PANDAS_NESTED)
def test_panda_parallel_env_in_workers(collector):
    check_panda(PANDAS_NESTED[collector])


def check_panda(make_collector):
    rb = TensorDictReplayBuffer(
        storage=LazyTensorStorage(100),
        transform=HindsightRelabel(panda.reward_fn),
        batch_size=128,
    )
    share, written = [], 0
    for data in collect(make_collector, 8 * 3, 8 * 3 * 12):
        rb.extend(data.reshape(-1))
        written += data.numel()
        mask = panda.check_batch(rb.sample(), rb.storage[:])
        share.append(mask.float().mean())
    assert written > 2 * len(rb) == 200  # it was full, and written over
    assert abs(sum(share) / len(share) - 0.8) < 0.1


def test_augment_of_a_collectors_data():
    rb = TensorDictReplayBuffer(
        storage=LazyTensorStorage(5000), transform=HindsightAugment(reward_fn, k=2)
    )
    for data in collect(SINGLE, 3 * 5, 3 * 5 * 20):
        rb.extend(data)
    stored = rb.storage[:]
    check_batch(stored, stored, "future")
    assert 3 * (~relabelled(stored)).sum() == len(stored)
