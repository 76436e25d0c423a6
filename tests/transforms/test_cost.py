"""Time and memory beside other buffers, on one thread (OMP_NUM_THREADS=1)."""

import statistics
import time

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers import HERReplayBuffer

from torch_panda.transforms import HindsightRelabel

EPISODE = 50


def reward_fn(achieved, desired):
    return -((achieved - desired).norm(dim=-1, keepdim=True) > 0.05).float()


class Source:
    """Transitions like those of Push, 50 steps an episode, flattened."""

    def __init__(self, num_envs):
        self.time = torch.arange(num_envs) * 7 % EPISODE
        self.num_envs = num_envs
        self.episode = torch.zeros(num_envs, dtype=torch.int64)

    def chunk(self, steps):
        time = self.time[:, None] + torch.arange(steps)
        episode = self.episode[:, None] + time // EPISODE
        self.time += steps
        shape = (self.num_envs, steps)
        done = (time % EPISODE == EPISODE - 1)[..., None]

        def observation():
            sizes = {"observation": 18, "achieved_goal": 3, "desired_goal": 3}
            values = {key: torch.randn(*shape, n) for key, n in sizes.items()}
            return values | {"success": torch.zeros_like(done)}

        def flags(done):
            terminated = torch.zeros_like(done)
            return {"done": done, "terminated": terminated, "truncated": done.clone()}

        ids = episode * self.num_envs + torch.arange(self.num_envs)[:, None]
        reward = torch.zeros(*shape, 1)
        return TensorDict(
            {
                **observation(),
                **flags(torch.zeros_like(done)),
                "action": torch.randn(*shape, 4),
                "collector": {"traj_ids": ids},
                "next": {**observation(), **flags(done), "reward": reward},
            },
            shape,
        ).reshape(-1)


def make(kind, capacity):
    storage = LazyTensorStorage(capacity)
    if kind == "HERReplayBuffer":

        def reward(td):
            return reward_fn(td["next", "achieved_goal"], td["desired_goal"])

        return HERReplayBuffer(reward, storage=storage, batch_size=256)
    transform = HindsightRelabel(reward_fn) if kind == "HindsightRelabel" else None
    return TensorDictReplayBuffer(storage=storage, transform=transform, batch_size=256)


def cycles(buffers, num_envs, rounds=15, repeats=30):
    """Median time of extend(50) + sample() of each buffer, taken in turns [s]."""
    sources = {kind: Source(num_envs) for kind in buffers}
    for source in sources.values():
        source.episode += 10**6
    taken = {kind: [] for kind in buffers}
    for _ in range(rounds):
        for kind, rb in buffers.items():
            source = sources[kind]
            data = [source.chunk(50 // num_envs) for _ in range(repeats)]
            start = time.perf_counter()
            for batch in data:
                rb.extend(batch)
                rb.sample()
            taken[kind].append((time.perf_counter() - start) / repeats)
    return {kind: statistics.median(times) for kind, times in taken.items()}


def fill(kind, capacity, stored):
    rb, source = make(kind, capacity), Source(50)
    while len(rb) < stored:
        rb.extend(source.chunk(min(1000, stored // 50)))
    return rb


@pytest.fixture(autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.mark.slow
@pytest.mark.parametrize("num_envs", [1, 5, 50])
@pytest.mark.parametrize("stored", [10_000, 100_000, 1_000_000])
def test_cycle_beside_a_plain_buffer(num_envs, stored, record_property):
    kinds = ["plain", "HindsightRelabel"]
    times = cycles({kind: fill(kind, stored, stored) for kind in kinds}, num_envs)
    ratio = times["HindsightRelabel"] / times["plain"]
    record_property("ratio", ratio)
    print({kind: f"{t * 1e3:.3f} ms" for kind, t in times.items()}, f"{ratio:.2f}x")
    if stored == 1_000_000:
        assert ratio <= 1.4


@pytest.mark.slow
def test_faster_than_her_replay_buffer():
    # HERReplayBuffer raises once it is full.
    kinds = ["HERReplayBuffer", "HindsightRelabel"]
    buffers = {kind: fill(kind, 1_100_000, 1_000_000) for kind in kinds}
    times = cycles(buffers, 1, rounds=5)
    print({kind: f"{t * 1e3:.3f} ms" for kind, t in times.items()})
    assert times["HindsightRelabel"] < times["HERReplayBuffer"]


@pytest.mark.parametrize(
    "capacity", [20_000, pytest.param(1_000_000, marks=pytest.mark.slow)]
)
def test_memory_a_transition(capacity):
    rb, source = make("HindsightRelabel", capacity), Source(50)
    for _ in range(100):
        rb.extend(source.chunk(capacity // 2500))
        rb.sample()
    serial = rb.storage[:]["hindsight_serial"]
    total = rb.transform[0]._memory.nbytes() + serial.nbytes
    print(f"{total / capacity:.1f} bytes a transition")
    assert total / capacity <= 3 * 4 + 24
