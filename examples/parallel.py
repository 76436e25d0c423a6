"""Several processes: torchrl's ParallelEnv, and a collector with worker processes.

    python examples/parallel.py

`torch_panda.make(id, num_envs=n)` already steps n simulations in parallel threads of
one process, which is the fastest way on one machine. Several processes are faster only
where the policy or the transforms of the environment are slow Python code.
"""

from functools import partial

import torch
from torchrl.collectors import MultiSyncCollector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import ParallelEnv

import torch_panda
from torch_panda.bullet.pool import num_cores
from torch_panda.transforms import HindsightRelabel

NUM_WORKERS = 2
NUM_ENVS = 4  # simulations in each worker
TOTAL_STEPS = 3_200


def make_env(seed: int) -> torch_panda.RobotTaskEnv:
    """The environments of one worker.

    An episode depends on (seed, environment, number of the episode) alone, so two
    workers with the same seed would run the same episodes. The workers share the cores.
    """
    threads = max(1, num_cores() // NUM_WORKERS)
    return torch_panda.make(
        "PandaPush-v1", num_envs=NUM_ENVS, num_threads=threads, seed=seed
    )


def roll_out() -> torch.Tensor:
    """Step a ParallelEnv, and return the goals of its first episodes.

    Returns:
        (workers, environments, 3), positions [m].
    """
    makers = [partial(make_env, seed=worker) for worker in range(NUM_WORKERS)]
    env = ParallelEnv(NUM_WORKERS, makers)
    try:
        data = env.rollout(10)
        print(f"ParallelEnv: a rollout of shape {tuple(data.shape)}")
        return data["desired_goal"][:, :, 0]
    finally:
        env.close()


def collect() -> TensorDictReplayBuffer:
    """Fill a replay buffer with the episodes of all workers, and relabel them.

    The workers number their trajectories from one shared counter, so hindsight tells
    the trajectories apart by ``("collector", "traj_ids")``.
    """
    with make_env(seed=0) as env:  # read for its reward function and settings
        relabel = HindsightRelabel.from_env(env)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(100_000), transform=relabel, batch_size=256
    )
    collector = MultiSyncCollector(
        [partial(make_env, seed=worker) for worker in range(NUM_WORKERS)],
        frames_per_batch=400 * NUM_WORKERS,  # one episode of each environment is 200
        total_frames=TOTAL_STEPS,
    )
    try:
        for data in collector:
            buffer.extend(data.reshape(-1))
            success = buffer.sample()["next", "success"].float().mean()
            print(f"{len(buffer)} steps: {success:.0%} of a relabelled batch succeed")
    finally:
        collector.shutdown()
    return buffer


if __name__ == "__main__":  # worker processes import this file
    roll_out()
    collect()
