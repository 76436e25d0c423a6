"""Imitation of demonstrations by gradient steps, before or without rewards."""

import time

from tensordict import TensorDictBase
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from tqdm import tqdm

from torch_panda.learning.checkpoint import SAVE_INTERVAL, Checkpoint


def make_demo_buffer(demos: TensorDictBase) -> TensorDictReplayBuffer:
    """Make a buffer that holds these transitions with their original goals."""
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
    """Imitate demonstrations, from the current progress of a run on, and save the run.

    The learning rate falls linearly to 0.

    Args:
        checkpoint: State of the run.
        demos: Demonstrations.
        updates: Number of gradient steps, with those that the run has taken already.
        batch_size: Transitions per gradient step.
        learning_rate: Factor on the learning rate of training, at the first step.
        stop: Ends the imitation early when it is true.
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
