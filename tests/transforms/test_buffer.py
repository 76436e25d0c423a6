"""A transform finds the buffer that calls it."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer
from torchrl.envs import Compose, DoubleToFloat, Transform

from torch_panda.transforms.buffer import find_buffer


class Recorder(Transform):
    """Records the callers that `find_buffer` finds."""

    def __init__(self):
        super().__init__()
        self.callers = []

    def _inv_call(self, tensordict):
        self.callers.append(find_buffer())
        return tensordict

    def forward(self, tensordict):
        self.callers.append(find_buffer())
        return tensordict


def make(recorder, cls=TensorDictReplayBuffer, **options):
    storage = LazyTensorStorage(10)
    rb = cls(storage=storage, transform=recorder, batch_size=4, **options)
    rb.extend(DATA)
    return rb


DATA = TensorDict({"x": torch.arange(10)}, [10])


@pytest.mark.parametrize("cls", [ReplayBuffer, TensorDictReplayBuffer])
@pytest.mark.parametrize("nested", [False, True])
def test_extend_add_and_sample_are_found(cls, nested):
    recorder = Recorder()
    rb = make(Compose(DoubleToFloat(), Compose(recorder)) if nested else recorder, cls)
    rb.add(DATA[0])
    rb.sample()
    assert [method for _, method in recorder.callers] == ["extend", "add", "_sample"]
    assert all(buffer is rb for buffer, _ in recorder.callers)


def test_a_thread_that_prefetches_is_found():
    recorder = Recorder()
    rb = make(recorder, prefetch=2)
    rb.sample()
    rb.shutdown()
    assert recorder.callers[-1] == (rb, "_sample")


def test_replacing_rows_raises():
    rb = make(Recorder())
    with pytest.raises(RuntimeError, match=r"replacing.*use extend"):
        rb[2:4] = DATA[:2]
