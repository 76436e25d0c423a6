"""Several processes: torchrl's ParallelEnv, and a collector with worker processes.

    python examples/parallel.py

`torch_panda.make(id, num_envs=n)` already steps n simulations in parallel threads of
one process, which is the fastest way on one machine. Several processes are faster only
where the policy or the transforms of the environment are slow Python code.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.process import BaseProcess
from signal import SIGTERM

import torch
from torchrl.collectors import MultiSyncCollector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import ParallelEnv

import torch_panda
from torch_panda.bullet.pool import num_cores
from torch_panda.transforms import HindsightRelabel

NUM_WORKERS, NUM_ENVS = 2, 4  # NUM_ENVS simulations in each worker
TOTAL_STEPS = 3_200


def make_env(seed: int) -> torch_panda.RobotTaskEnv:
    """The environments of one worker.

    Two workers with the same seed would run the same episodes. All share the cores.
    """
    threads = max(1, num_cores() // NUM_WORKERS)
    return torch_panda.make(
        "PandaPush-v1", num_envs=NUM_ENVS, num_threads=threads, seed=seed
    )


def roll_out() -> torch.Tensor:
    """Step a ParallelEnv; return the first goals [m], (workers, environments, 3)."""
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
        with name_dead_workers(collector.procs):
            for data in collector:
                buffer.extend(data.reshape(-1))
                success = buffer.sample()["next", "success"].float().mean()
                print(f"{len(buffer)} steps: {success:.0%} of a batch succeed")
    finally:
        collector.shutdown()
    return buffer


@contextmanager
def name_dead_workers(processes: Sequence[BaseProcess]) -> Iterator[None]:
    """Context manager that makes the error of a killed worker name the worker.

    torchrl notices a killed worker within about a second and ends the others. If one
    takes longer than 0.1 s to end, the error of torchrl 0.14 does not name any.
    """
    try:
        yield
    except (RuntimeError, ValueError) as error:
        for index, process in enumerate(processes):
            with suppress(ValueError):  # torchrl closes the processes that it ends
                if process.exitcode not in (None, 0, -SIGTERM):  # it sends SIGTERM
                    text = f"worker {index} (process {process.pid}) died with exit code"
                    raise RuntimeError(f"{text} {process.exitcode}") from error
        raise


if __name__ == "__main__":  # worker processes import this file
    roll_out()
    collect()
