"""What transforms that only make sense in a replay buffer have in common."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.envs import EnvBase, MultiStepTransform, Transform

from torch_panda.transforms.rewrite import GoalFunction, Rewriter
from torch_panda.transforms.strategies import Strategy, check_strategy


class BufferTransform(Transform):
    """A transform that refuses environments, and n-step rewards beside it."""

    def __init__(
        self,
        reward_fn: GoalFunction,
        *,
        strategy: str | Strategy,
        goal_key: NestedKey,
        achieved_goal_key: NestedKey,
        reward_key: NestedKey,
        terminated_fn: GoalFunction | None,
        trajectory_key: NestedKey,
        single_env: bool,
        seed: int | None,
    ) -> None:
        super().__init__()
        check_strategy(strategy)
        if not callable(reward_fn):
            raise ValueError(f"reward_fn must be a function, got {reward_fn!r}.")
        self.strategy = strategy
        self.trajectory_key = trajectory_key
        self.single_env = single_env
        self._rewriter = Rewriter(
            reward_fn, terminated_fn, goal_key, achieved_goal_key, reward_key
        )
        self._generator: torch.Generator | None = None
        if seed is not None:
            self._generator = torch.Generator("cpu").manual_seed(seed)
        self._is_chain_checked = False

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
        self.empty_cache()

    def empty_cache(self) -> None:
        """Is called by a chain when it changes: n-step rewards are looked for again."""
        super().empty_cache()
        self._is_chain_checked = False

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        raise ValueError(self._env_error())

    def _env_error(self) -> str:
        name = type(self).__name__
        return f"{name} can only be applied to replay buffers, not to environments."

    def _generator_state(self) -> torch.Tensor | None:
        return None if self._generator is None else self._generator.get_state()

    def _load_generator(self, state: torch.Tensor | None) -> None:
        if state is not None:
            self._generator = self._generator or torch.Generator("cpu")
            self._generator.set_state(state)

    def _check_chain(self) -> None:
        """Raises a RuntimeError if the buffer makes rewards of n steps."""
        if self._is_chain_checked:
            return
        chain: Transform | None = self
        while chain is not None:  # chains may be nested
            root, container = chain, chain.__dict__["_container"]
            chain = container() if container is not None else None
        for transform in root.modules():
            if isinstance(transform, MultiStepTransform):
                raise RuntimeError(
                    f"{type(self).__name__} cannot be combined with "
                    "MultiStepTransform: the reward of n steps cannot be recomputed "
                    "from one transition. Sample slices with "
                    'HindsightRelabel(unit="slice") instead.'
                )
        self._is_chain_checked = True
