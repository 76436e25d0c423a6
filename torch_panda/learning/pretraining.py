"""Imitation of demonstrations before (or without) reinforcement learning."""

import time

from torchrl.data import TensorDictReplayBuffer
from tqdm import tqdm

from torch_panda.learning.checkpoint import SAVE_INTERVAL, Checkpoint


def pretrain(
    checkpoint: Checkpoint,
    demos: TensorDictReplayBuffer,
    *,
    updates: int,
    batch_size: int,
    learning_rate: float = 1.0,
    stop: object,
) -> None:
    """Take the remaining gradient steps of imitation, and save the run.

    The learning rate falls linearly to 0.

    Args:
        checkpoint: State of the run.
        demos: Demonstrations.
        updates: Total number of gradient steps, including the steps before a resume.
        batch_size: Transitions per gradient step.
        learning_rate: Learning rate of the first step, divided by `LEARNING_RATE`.
        stop: Object that becomes true to end the imitation early, such as `StopSignal`.
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
