"""What stepping and learning at once would gain: pytest -m slow -s this file."""

import statistics
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from torch_panda.learning.options import default_args
from torch_panda.learning.training import Run

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]
ROUNDS = 7


@pytest.fixture
def run(tmp_path):
    args = default_args("tuned", "PandaPush-v1")
    args.updates_per_step = 0
    args.preset = "paper"  # stores all episodes
    threads, precision = torch.get_num_threads(), torch.get_float32_matmul_precision()
    run = Run(args, tmp_path)
    yield run
    run.close()
    torch.set_num_threads(threads)
    torch.set_float32_matmul_precision(precision)


def seconds(work):
    started = time.perf_counter()
    work()
    return time.perf_counter() - started


def test_taking_turns_loses_little(run):
    """An iteration of the tuned preset: an episode each, half as many updates.

    Taking turns keeps `--resume` bit for bit. The threads that step leave Python's
    lock to the updates, but not the cores and their caches.
    """
    batches = iter(run.collector)
    data = next(batches)
    run.store(data)
    updates = data.numel() // 2

    def step():
        next(batches)

    def update():
        for _ in range(updates):
            run.agent.update(run.buffer.sample(run.args.batch_size))

    def take_turns():
        step()
        update()

    def at_once():
        with ThreadPoolExecutor(1) as pool:
            stepping = pool.submit(step)
            update()
            stepping.result()

    def two_threads():
        torch.set_num_threads(2)
        take_turns()
        torch.set_num_threads(1)

    ways = {
        "steps": step,
        "updates": update,
        "in turns": take_turns,
        "at once": at_once,
        "in turns, two torch threads": two_threads,
    }
    taken = {name: [] for name in ways}
    update()
    for _ in range(ROUNDS):
        for name, way in ways.items():
            taken[name].append(seconds(way))
    median = {name: statistics.median(times) for name, times in taken.items()}
    print(f"\n{data.numel() / median['steps']:.0f} steps/s alone")
    print(f"{updates / median['updates']:.0f} updates/s alone")
    for name in list(ways)[3:]:
        gains = [a / b for a, b in zip(taken["in turns"], taken[name], strict=True)]
        print(
            f"{name}: {statistics.median(gains):.2f} times as fast as in turns "
            f"({min(gains):.2f} to {max(gains):.2f})"
        )
    assert median["in turns"] <= 1.15 * median["at once"]
