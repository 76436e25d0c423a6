"""Transitions of an expert, to learn from beside one's own."""

from pathlib import Path

from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from torch_panda import RobotTaskEnv
from training import files
from training.buffers import STORED_KEYS


def read_demos(path: Path, env: RobotTaskEnv) -> TensorDictBase:
    """Transitions (n,) of whole episodes.

    Raises:
        ValueError: the file holds none, or none of such an environment.
    """
    content = files.read(path, "demonstrations", STORED_KEYS)
    try:
        demos = TensorDict(content, [len(content["action"])]).select(*STORED_KEYS)
    except (RuntimeError, TypeError) as error:  # other lengths, or no tensors
        raise ValueError(f"{path} does not hold demonstrations: {error}") from None
    if not len(demos):
        raise ValueError(f"{path} holds no transitions")
    for key in ("observation", "action", "desired_goal"):
        expected = env.full_observation_spec.get(key, None)
        size = (env.action_spec if expected is None else expected).shape[-1]
        if demos[key].shape[-1] != size:
            raise ValueError(
                f"{path}: {key} has size {demos[key].shape[-1]}, the task's has {size}"
            )
    return demos.to(env.device)


def make_demo_buffer(demos: TensorDictBase) -> TensorDictReplayBuffer:
    """A buffer that holds these transitions with their own goals."""
    storage = LazyTensorStorage(len(demos), device=demos.device)
    buffer = TensorDictReplayBuffer(storage=storage)
    buffer.extend(demos)
    return buffer
