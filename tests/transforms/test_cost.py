"""Time and memory beside other buffers, on one thread (OMP_NUM_THREADS=1)."""

import statistics
import sys
import time

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers import HERReplayBuffer

from torch_panda.transforms import HindsightRelabel

EPISODE = 50
OBSERVATION = {"observation": 18, "achieved_goal": 3, "desired_goal": 3}
ACTION = 4


def reward_fn(achieved, desired):
    distance = torch.linalg.vector_norm(achieved - desired, dim=-1, keepdim=True)
    return (distance > 0.05).float().neg()


class Source:
    """Transitions like those of Push, 50 steps an episode, flattened."""

    def __init__(self, num_envs):
        self.time = torch.arange(num_envs) * 7 % EPISODE
        self.num_envs = num_envs
        self.episode = torch.zeros(num_envs, dtype=torch.int64)
        self.achieved = torch.zeros(num_envs, 3)

    def chunk(self, steps):
        time = self.time[:, None] + torch.arange(steps)
        episode = self.episode[:, None] + time // EPISODE
        self.time += steps
        shape = (self.num_envs, steps)
        done = (time % EPISODE == EPISODE - 1)[..., None]

        def observation(achieved):
            values = {key: torch.randn(*shape, n) for key, n in OBSERVATION.items()}
            values["achieved_goal"] = achieved.clone()
            return values | {"success": torch.zeros_like(done)}

        def flags(done):
            terminated = torch.zeros_like(done)
            return {"done": done, "terminated": terminated, "truncated": done.clone()}

        # A step begins at the goal that the one before has achieved.
        achieved = torch.randn(self.num_envs, steps + 1, 3)
        achieved[:, 0] = self.achieved
        self.achieved = achieved[:, -1]

        ids = episode * self.num_envs + torch.arange(self.num_envs)[:, None]
        reward = torch.zeros(*shape, 1)
        return TensorDict(
            {
                **observation(achieved[:, :-1]),
                **flags(torch.zeros_like(done)),
                "action": torch.randn(*shape, ACTION),
                "collector": {"traj_ids": ids},
                "next": {
                    **observation(achieved[:, 1:]),
                    **flags(done),
                    "reward": reward,
                },
            },
            shape,
        ).reshape(-1)


class GoalEnv(gymnasium.Env):
    """What Stable-Baselines3's buffer asks of an environment: spaces and reward."""

    observation_space = gymnasium.spaces.Dict(
        {
            key: gymnasium.spaces.Box(-np.inf, np.inf, (n,), np.float32)
            for key, n in OBSERVATION.items()
        }
    )
    action_space = gymnasium.spaces.Box(-1, 1, (ACTION,), np.float32)

    def compute_reward(self, achieved_goal, desired_goal, info):
        distance = np.linalg.norm(achieved_goal - desired_goal, axis=-1)
        return -(distance > 0.05).astype(np.float32)


class StableBaselines3:
    """Its `HerReplayBuffer`, for the same data: one `add` a step."""

    def __init__(self, capacity, num_envs):
        env = DummyVecEnv([GoalEnv] * num_envs)
        spaces = env.observation_space, env.action_space
        self.buffer = HerReplayBuffer(
            capacity, *spaces, env=env, n_envs=num_envs, device="cpu"
        )
        self.num_envs = num_envs

    def __len__(self):
        return self.buffer.size() * self.num_envs

    def prepare(self, data):
        data = data.reshape(self.num_envs, -1)
        infos = [{} for _ in range(self.num_envs)]

        def observation(td):
            return {key: td[key].numpy() for key in OBSERVATION}

        return [
            (
                observation(step),
                observation(step["next"]),
                step["action"].numpy(),
                step["next", "reward"].squeeze(-1).numpy(),
                step["next", "done"].squeeze(-1).numpy(),
                infos,
            )
            for step in data.unbind(1)
        ]

    def extend(self, steps):
        for step in steps:
            self.buffer.add(*step)

    def sample(self):
        return self.buffer.sample(256)


def make(kind, capacity, num_envs):
    if kind == "Stable-Baselines3":
        return StableBaselines3(capacity, num_envs)
    storage = LazyTensorStorage(capacity)
    if kind == "HERReplayBuffer":

        def reward(td):
            return reward_fn(td["next", "achieved_goal"], td["desired_goal"])

        return HERReplayBuffer(reward, storage=storage, batch_size=256)
    transform = HindsightRelabel(reward_fn) if kind == "HindsightRelabel" else None
    return TensorDictReplayBuffer(storage=storage, transform=transform, batch_size=256)


def prepare(rb, data):
    return rb.prepare(data) if isinstance(rb, StableBaselines3) else data


def fill(kind, capacity, num_envs, stored=None):
    """Returns a buffer and the environments whose transitions it holds."""
    rb, source = make(kind, capacity, num_envs), Source(num_envs)
    while len(rb) < (stored or capacity):
        rb.extend(prepare(rb, source.chunk(1000 // num_envs)))
    return rb, source


def cycles(filled, rounds=20, repeats=20):
    """Times extend(50 transitions) + sample(256), the buffers in turns [s].

    CPU time of the only thread, as other processes may share the machine.
    """
    taken = {name: [] for name in filled}
    for _ in range(rounds):
        for name, (rb, source) in filled.items():
            steps = 50 // source.num_envs
            data = [prepare(rb, source.chunk(steps)) for _ in range(repeats)]
            start = time.thread_time()
            for batch in data:
                rb.extend(batch)
                rb.sample()
            taken[name].append((time.thread_time() - start) / repeats)
    median = {name: statistics.median(times) for name, times in taken.items()}
    print({name: f"{value * 1e6:.0f} us" for name, value in median.items()})
    return median


@pytest.fixture(autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.mark.slow
@pytest.mark.parametrize("num_envs", [1, 5, 50])
def test_cycle_beside_a_plain_buffer(num_envs):
    kinds = ["plain", "HindsightRelabel"]
    times = cycles({kind: fill(kind, 1_000_000, num_envs) for kind in kinds})
    ratio = times["HindsightRelabel"] / times["plain"]
    print(f"{num_envs} environments: {ratio:.2f}x")
    assert ratio <= 1.6


@pytest.mark.slow
def test_added_cost_grows_no_more_than_a_plain_cycle():
    """Nothing is searched: reads of more rows miss the caches more often, as there."""
    sizes = [10_000, 100_000, 1_000_000]
    kinds = ["plain", "HindsightRelabel"]
    times = cycles({(k, n): fill(k, n, 5) for n in sizes for k in kinds}, rounds=40)
    plain = [times["plain", n] for n in sizes]
    added = [times["HindsightRelabel", n] - times["plain", n] for n in sizes]
    assert added[1] / added[0] < plain[1] / plain[0]
    assert added[2] / added[0] < plain[2] / plain[0]


@pytest.mark.slow
def test_faster_than_her_replay_buffer():
    # HERReplayBuffer raises once it is full.
    kinds = ["HERReplayBuffer", "HindsightRelabel"]
    buffers = {kind: fill(kind, 1_100_000, 1, 1_000_000) for kind in kinds}
    times = cycles(buffers, rounds=5)
    assert times["HindsightRelabel"] < times["HERReplayBuffer"]


@pytest.mark.slow
@pytest.mark.parametrize("num_envs", [1, 5, 50])
def test_faster_than_stable_baselines3(num_envs):
    kinds = ["Stable-Baselines3", "HindsightRelabel"]
    buffers = {kind: fill(kind, 1_000_000, num_envs) for kind in kinds}
    times = cycles(buffers, rounds=5)
    assert times["HindsightRelabel"] < times["Stable-Baselines3"]


@pytest.mark.parametrize(
    "capacity", [20_000, pytest.param(1_000_000, marks=pytest.mark.slow)]
)
def test_memory_a_transition(capacity):
    rb, source = make("HindsightRelabel", capacity, 50), Source(50)
    for _ in range(100):
        rb.extend(source.chunk(capacity // 2500))
        rb.sample()
    serial = rb.storage[:]["hindsight_serial"]
    memory = rb.transform[0]._memory
    own = sum(x.nbytes for x in vars(memory).values() if isinstance(x, np.ndarray))
    lists = sum(map(sys.getsizeof, memory._free_regions.values()))
    lists += sys.getsizeof(memory._unused)
    total = own + lists + serial.nbytes
    print(f"{total / capacity:.1f} bytes a transition")
    assert total / capacity <= 3 * 4 + 24
