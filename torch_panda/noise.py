"""Transforms for TorchRL that add noise to observations and actions, or delay actions.

    env = TransformedEnv(make(...), Compose(ActionDelay(1), ActionNoise(0.05)))

A rollout stores the action that the policy chose, before delay and noise, and the
observation that the policy saw, with its noise.
"""

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import Transform

from torch_panda.checks import check_integer, check_not_negative


class GaussianNoise:
    """Adds Gaussian noise from a random generator of its own.

    Args:
        std: Standard deviation.
        seed: Seed of the generator; None draws one from the operating system.

    Raises:
        ValueError: ``std`` is negative or not finite.
    """

    def __init__(self, std: float, seed: int | None) -> None:
        check_not_negative(std=std)
        self._std = std
        self._seed = seed
        self._generator: torch.Generator | None = None

    def add(self, value: Tensor) -> Tensor:
        """Return the sum of a tensor and new noise of the same shape."""
        if self._generator is None:  # make it in the process that uses it
            self._generator = torch.Generator(value.device)
            if self._seed is None:
                self._generator.seed()
            else:
                self._generator.manual_seed(self._seed)
        noise = torch.empty_like(value).normal_(
            0.0, self._std, generator=self._generator
        )
        return value + noise

    def __getstate__(self) -> dict[str, object]:
        return {**vars(self), "_generator": None}  # generators cannot be pickled


class ObservationNoise(Transform):
    """Adds Gaussian noise to observations. Goals and rewards stay exact.

    Args:
        std: Standard deviation, in the units of the observation.
        keys: Entries that get noise.
        seed: Seed of the noise; None draws one from the operating system.

    Raises:
        ValueError: ``std`` is negative or not finite.
    """

    def __init__(
        self,
        std: float,
        *,
        keys: Sequence[NestedKey] = ("observation",),
        seed: int | None = None,
    ) -> None:
        super().__init__(in_keys=list(keys), out_keys=list(keys))
        self._noise = GaussianNoise(std, seed)

    def _apply_transform(self, obs: Tensor) -> Tensor:
        return self._noise.add(obs)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)


class ActionNoise(Transform):
    """Adds Gaussian noise to the actions that the environment gets.

    Args:
        std: Standard deviation. Actions range from -1 to 1.
        seed: Seed of the noise; None draws one from the operating system.

    Raises:
        ValueError: ``std`` is negative or not finite.
    """

    def __init__(self, std: float, *, seed: int | None = None) -> None:
        super().__init__(in_keys_inv=["action"], out_keys_inv=["action"])
        self._noise = GaussianNoise(std, seed)

    def _inv_apply_transform(self, action: Tensor) -> Tensor:
        return self._noise.add(action)


class ActionDelay(Transform):
    """Delays actions by some steps. The first actions of an episode are zero.

    Args:
        steps: Number of steps, at least 1.

    Raises:
        ValueError: ``steps`` is below 1.
        TypeError: ``steps`` is not an integer.
    """

    def __init__(self, steps: int) -> None:
        steps = check_integer("steps", steps)
        if steps < 1:
            raise ValueError(f"steps must be at least 1, got {steps}")
        super().__init__(in_keys_inv=["action"], out_keys_inv=["action"])
        self._steps = steps
        self._queue: list[Tensor] = []  # delayed actions, oldest first

    def _inv_apply_transform(self, action: Tensor) -> Tensor:
        if not self._queue:
            self._queue = [torch.zeros_like(action) for _ in range(self._steps)]
        self._queue.append(action.clone())
        return self._queue.pop(0)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        mask = tensordict.get("_reset", None)
        if mask is None:
            self._queue = []
        elif self._queue:
            is_reset = mask.reshape(*self._queue[0].shape[:-1], 1)
            self._queue = [action * ~is_reset for action in self._queue]
        return tensordict_reset
