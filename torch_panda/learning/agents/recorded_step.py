"""Records a gradient step as a CUDA graph.

The networks are small, so that a GPU spends most of a gradient step waiting for the CPU
to launch the next kernel. A CUDA graph launches all kernels of the step at once.
"""

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor

WARM_UP = 3  # steps before the recording, as in torch's documentation of CUDA graphs

Step = Callable[..., dict[str, Tensor]]


class RecordedStep:
    """Takes gradient steps on batches of a GPU. The first ones are taken as usual.

    A recording repeats kernels on the same memory, so each batch is copied to where the
    recorded one was. The step must neither read a number on the CPU nor copy one from
    there, and its Python code has no effect when the recording is replayed. Random
    numbers are new in each replay, and come from the generator of the device.

    Args:
        step: Maps TensorDicts to losses, scalars without gradients.
        optimizer: Optimizer that the step uses.
    """

    def __init__(self, step: Step, optimizer: torch.optim.Optimizer) -> None:
        self.step, self.optimizer = step, optimizer
        self.steps_left = WARM_UP  # until the recording
        self.replay: Callable[[], dict[str, Tensor]] | None = None
        self.batches: list[TensorDictBase] = []  # that the recording reads

    def __call__(self, *batches: TensorDictBase) -> dict[str, Tensor]:
        """Take a step.

        Args:
            *batches: Arguments of the step. Keys, sizes and types are the same in all
                calls.
        """
        if self.steps_left:
            self.steps_left -= 1
            return take_aside(lambda: self.step(*batches))
        if self.replay is None:
            self.batches = [batch.clone() for batch in batches]
            self.replay = record(lambda: self.step(*self.batches), self.optimizer)
        for recorded, batch in zip(self.batches, batches, strict=True):
            recorded.update_(batch)
        return {key: loss.clone() for key, loss in self.replay().items()}


def take_aside(step: Callable[[], dict[str, Tensor]]) -> dict[str, Tensor]:
    """Take a step on a stream of its own, as CUDA graphs require of the first steps."""
    stream, current = torch.cuda.Stream(), torch.cuda.current_stream()
    stream.wait_stream(current)
    with torch.cuda.stream(stream):
        losses = step()
    current.wait_stream(stream)
    return losses


def record(
    step: Callable[[], dict[str, Tensor]], optimizer: torch.optim.Optimizer
) -> Callable[[], dict[str, Tensor]]:
    """Record a step without taking it.

    Returns:
        Function that takes the step. It returns the same tensors in every call.
    """
    graph = torch.cuda.CUDAGraph()
    # The optimizer checks this flag only while it is recorded.
    for group in optimizer.param_groups:
        group["capturable"] = True
    with torch.cuda.graph(graph):
        losses = step()
    for group in optimizer.param_groups:
        group["capturable"] = False

    def replay() -> dict[str, Tensor]:
        graph.replay()
        return losses

    return replay
