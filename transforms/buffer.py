"""Finds the replay buffer that calls a transform, and the transforms next to it."""

import inspect

from torchrl.data import ReplayBuffer, SliceSampler
from torchrl.data.replay_buffers.sample_units import Sequence
from torchrl.envs import EnvBase, Transform


def find_buffer() -> tuple[ReplayBuffer | None, str]:
    """Finds the replay buffer that is calling the transform, and the calling method.

    torchrl gives a transform no reference to its buffer. But hindsight depends on the
    buffer's size, storage, writer and sampler. So this function walks up the call stack
    (3 us) to the innermost function of `torchrl.data` whose `self` is a buffer.

    Returns:
        The buffer and the name of its method, such as "extend". If no buffer is
        calling, as in `transform.forward(batch)`: None and "".

    Raises:
        RuntimeError: The buffer replaces stored rows (`rb[i] = ...`).
    """
    frame = inspect.currentframe()
    while frame is not None:
        if frame.f_globals.get("__name__", "").startswith("torchrl.data."):
            buffer = frame.f_locals.get("self")
            if isinstance(buffer, ReplayBuffer):
                method = frame.f_code.co_name
                if method == "__setitem__":
                    raise RuntimeError(
                        "hindsight does not support replacing rows (rb[i] = ...): use "
                        "extend()"
                    )
                return buffer, method
        frame = frame.f_back
    return None, ""


def samples_slices(buffer: ReplayBuffer | None) -> bool:
    """Returns whether the buffer samples slices of trajectories."""
    sampler, unit = getattr(buffer, "sampler", None), getattr(buffer, "_sample_unit", 0)
    return isinstance(sampler, SliceSampler) or isinstance(unit, Sequence)


def get_chain(transform: Transform) -> list[Transform | EnvBase]:
    """Returns all transforms of a transform's buffer, in order.

    The transforms may be nested in several `Compose`.
    """
    root: Transform | EnvBase = transform
    while (container := root.__dict__["_container"]) and container():
        root = container()
    return [module for module in root.modules() if isinstance(module, Transform)]
