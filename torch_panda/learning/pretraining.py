"""Gradient steps that only imitate demonstrations, before or without rewards."""

import time

from tensordict import TensorDictBase
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from tqdm import tqdm

from torch_panda.learning.checkpoint import SAVE_INTERVAL, Checkpoint


def make_demo_buffer(demos: TensorDictBase) -> TensorDictReplayBuffer:
    """A buffer that holds these transitions with their own goals."""
    storage = LazyTensorStorage(len(demos), device=demos.device or "cpu")
    buffer = TensorDictReplayBuffer(storage=storage)
    buffer.extend(demos)
    return buffer


def pretrain(
    checkpoint: Checkpoint,
    demos: TensorDictReplayBuffer,
    *,
    updates: int,
    batch_size: int,
    learning_rate: float = 1.0,
    stop: object = False,
) -> None:
    """Take gradient steps that only imitate, from where the run is, and save it.

    Args:
        checkpoint: of the run.
        demos: to imitate.
        updates: gradient steps, over all.
        batch_size: transitions per gradient step.
        learning_rate: at first, of that of training; it falls to 0 meanwhile.
        stop: ends this early when it is true.
    """
    agent, progress = checkpoint.agent, checkpoint.progress
    bar = tqdm(
        desc="imitation", initial=progress.pretrained, total=updates, unit="update"
    )
    while progress.pretrained < updates and not stop:
        started = time.perf_counter()
        agent.set_learning_rate(learning_rate * (1 - progress.pretrained / updates))
        agent.imitate(demos.sample(batch_size))
        progress.pretrained += 1
        progress.seconds += time.perf_counter() - started
        bar.update()
        if progress.pretrained % SAVE_INTERVAL == 0:
            checkpoint.save()
    bar.close()
    agent.set_learning_rate(1.0)
    checkpoint.save()
