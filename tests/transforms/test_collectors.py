import functools

import pytest
from torchrl.collectors import Collector, MultiAsyncCollector, MultiSyncCollector

from tests.transforms import toy
from tests.transforms.identifiable import check_batch, relabelled, reward_fn
from tests.transforms.pipelines import buffer
from torch_panda.transforms import HindsightRelabel

SINGLE = functools.partial(Collector, toy.make_env)
WORKERS = [toy.make_first, toy.make_second]
COLLECTORS = {
    "ParallelEnv": functools.partial(Collector, toy.make_parallel),
    "synchronous": functools.partial(MultiSyncCollector, WORKERS),
    "asynchronous": functools.partial(MultiAsyncCollector, WORKERS),
}


def collect(make_collector, frames_per_batch, total_frames, **options):
    collector = make_collector(
        None, frames_per_batch=frames_per_batch, total_frames=total_frames, **options
    )
    try:
        yield from collector
    finally:
        collector.shutdown()


def check(make_collector, frames, batches, *, ndim=1, **options):
    rb = buffer(HindsightRelabel(reward_fn), capacity=200, ndim=ndim)
    share, written = [], 0
    for data in collect(make_collector, frames, frames * batches, **options):
        rb.extend(data if ndim == 2 else data.reshape(-1))
        written += data.numel()
        batch = rb.sample()
        check_batch(batch, rb.storage[:], "future")
        share.append(relabelled(batch).float().mean())
    assert abs(sum(share) / len(share) - 0.8) < 0.1
    assert written == frames * batches


@pytest.mark.parametrize("reset_at_each_iter", [True, False])
@pytest.mark.parametrize(("ndim", "steps"), [(1, 1), (1, 5), (2, 17)])
def test_batches_of_a_single_process_are_relabelled(ndim, steps, reset_at_each_iter):
    check(SINGLE, 3 * steps, 20, ndim=ndim, reset_at_each_iter=reset_at_each_iter)


@pytest.mark.parametrize("collector", COLLECTORS)
def test_batches_of_worker_processes_are_relabelled(collector):
    check(COLLECTORS[collector], 6 * 4, 20)
