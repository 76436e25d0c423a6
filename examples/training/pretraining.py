"""Imitation of demonstrations before reinforcement learning."""

import time

from torchrl.data import TensorDictReplayBuffer
from tqdm import tqdm

from training.checkpoint import SAVE_INTERVAL, Checkpoint


def pretrain(
    checkpoint: Checkpoint,
    demos: TensorDictReplayBuffer,
    *,
    updates: int,
    batch_size: int,
    stop: object = False,
) -> None:
    """Take gradient steps that only imitate, from where the run is, and save it.

    Args:
        checkpoint: of the run, whose learning rate falls to 0 meanwhile.
        demos: to imitate.
        updates: gradient steps, over all.
        batch_size: transitions per gradient step.
        stop: ends this early when it is true.
    """
    agent, progress = checkpoint.agent, checkpoint.progress
    bar = tqdm(
        desc="imitation", initial=progress.pretrained, total=updates, unit="update"
    )
    while progress.pretrained < updates and not stop:
        started = time.perf_counter()
        agent.set_learning_rate(1 - progress.pretrained / updates)
        agent.imitate(demos.sample(batch_size))
        progress.pretrained += 1
        progress.seconds += time.perf_counter() - started
        bar.update()
        if progress.pretrained % SAVE_INTERVAL == 0:
            checkpoint.save()
    bar.close()
    agent.set_learning_rate(1.0)
    checkpoint.save()
