"""What transforms that only make sense in a replay buffer have in common."""

from __future__ import annotations

from tensordict import TensorDictBase
from torchrl.envs import Compose, EnvBase, MultiStepTransform, Transform


class BufferTransform(Transform):
    """A transform that refuses environments, and n-step rewards beside it."""

    # Tells torchrl that a buffer shared between processes needs share_memory_(), which
    # is not there: every process would write to a memory of its own.
    requires_shared_write_state = True

    def set_container(self, container: Transform | EnvBase) -> None:
        """Joins a buffer's chain of transforms.

        Raises:
            ValueError: the chain is an environment's.
        """
        if isinstance(container, EnvBase) or container.parent is not None:
            raise ValueError(self._env_error())
        super().set_container(container)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        raise ValueError(self._env_error())

    def _env_error(self) -> str:
        name = type(self).__name__
        return f"{name} can only be applied to replay buffers, not to environments."

    def _check_chain(self) -> None:
        """Raises a RuntimeError if the buffer makes rewards of n steps."""
        chain = self.__dict__["_container"]
        chain = chain() if chain is not None else None
        if not isinstance(chain, Compose):
            return
        for transform in chain.transforms:
            if isinstance(transform, MultiStepTransform):
                raise RuntimeError(
                    f"{type(self).__name__} cannot be combined with "
                    "MultiStepTransform: the reward of n steps cannot be recomputed "
                    "from one transition. Sample slices with "
                    'HindsightRelabel(unit="slice") instead.'
                )
