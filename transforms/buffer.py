"""The replay buffer that calls a transform, and the chain of transforms in it."""

import inspect

from torchrl.data import ReplayBuffer, SliceSampler
from torchrl.data.replay_buffers.sample_units import Sequence
from torchrl.envs import EnvBase, Transform


def find_buffer() -> tuple[ReplayBuffer | None, str]:
    """Finds the replay buffer that is calling, and its method.

    torchrl gives a transform no handle on its buffer. But the buffer's size, storage,
    writer and sampler decide whether hindsight is right. So this function walks up the
    stack (3 us) to the innermost function of `torchrl.data` whose `self` is a buffer.

    Returns:
        The buffer and the method's name, such as "extend"; or None and "" if no buffer
        calls, as in `transform.forward(batch)`.

    Raises:
        RuntimeError: the buffer replaces stored rows (`rb[i] = ...`).
    """
    frame = inspect.currentframe()
    while frame is not None:
        if frame.f_globals.get("__name__", "").startswith("torchrl.data."):
            buffer = frame.f_locals.get("self")
            if isinstance(buffer, ReplayBuffer):
                method = frame.f_code.co_name
                if method == "__setitem__":
                    raise RuntimeError(
                        "hindsight cannot follow rows that are replaced (rb[i] = ...): "
                        "use extend()"
                    )
                return buffer, method
        frame = frame.f_back
    return None, ""


def samples_slices(buffer: ReplayBuffer | None) -> bool:
    """Returns whether the buffer samples slices of trajectories."""
    sampler, unit = getattr(buffer, "sampler", None), getattr(buffer, "_sample_unit", 0)
    return isinstance(sampler, SliceSampler) or isinstance(unit, Sequence)


def get_chain(transform: Transform) -> list[Transform | EnvBase]:
    """Returns all transforms of the (nested) `Compose` that a transform belongs to."""
    root: Transform | EnvBase = transform
    while (container := root.__dict__["_container"]) and container():
        root = container()
    return [module for module in root.modules() if isinstance(module, Transform)]
