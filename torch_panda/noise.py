"""Noise and delay, as transforms of torchrl, which has none of its own.

    env = TransformedEnv(make(...), Compose(ActionDelay(1), ActionNoise(0.05)))

What is stored in a rollout is the policy's own action, and the observation it saw.
"""

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import Transform


class _Noise(Transform):
    """Gaussian noise from a generator of its own."""

    def __init__(
        self, std: float, seed: int | None, **keys: Sequence[NestedKey]
    ) -> None:
        if not 0 <= std < float("inf"):
            raise ValueError(f"std must be finite and at least 0, got {std}")
        super().__init__(**keys)
        self._std = std
        self._seed = seed
        self._generator: torch.Generator | None = None

    def _add_noise(self, value: Tensor) -> Tensor:
        if self._generator is None:  # in the process that uses it
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
        return {**super().__getstate__(), "_generator": None}  # cannot be copied


class ObservationNoise(_Noise):
    """Adds Gaussian noise to what is observed. Goals and rewards stay exact.

    Args:
        std: its standard deviation, in the units of the observation.
        keys: the entries.
        seed: of the noise; None takes one from the operating system.

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
        super().__init__(std, seed, in_keys=list(keys), out_keys=list(keys))

    def _apply_transform(self, obs: Tensor) -> Tensor:
        return self._add_noise(obs)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)


class ActionNoise(_Noise):
    """Adds Gaussian noise to actions on their way to the environment.

    Args:
        std: its standard deviation; actions go from -1 to 1.
        seed: of the noise; None takes one from the operating system.

    Raises:
        ValueError: ``std`` is negative or not finite.
    """

    def __init__(self, std: float, *, seed: int | None = None) -> None:
        super().__init__(std, seed, in_keys_inv=["action"], out_keys_inv=["action"])

    def _inv_apply_transform(self, action: Tensor) -> Tensor:
        return self._add_noise(action)


class ActionDelay(Transform):
    """Lets actions arrive some steps late; in an episode's first steps they are zero.

    Args:
        steps: how many, at least 1.

    Raises:
        ValueError: ``steps`` is below 1.
    """

    def __init__(self, steps: int) -> None:
        if steps < 1:
            raise ValueError(f"steps must be at least 1, got {steps}")
        super().__init__(in_keys_inv=["action"], out_keys_inv=["action"])
        self._steps = steps
        self._waiting: list[Tensor] = []  # actions, the next one first

    def _inv_apply_transform(self, action: Tensor) -> Tensor:
        if not self._waiting:
            self._waiting = [torch.zeros_like(action) for _ in range(self._steps)]
        self._waiting.append(action.clone())
        return self._waiting.pop(0)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        mask = tensordict.get("_reset", None)
        if mask is None:
            self._waiting = []
        elif self._waiting:
            began = mask.reshape(*self._waiting[0].shape[:-1], 1)
            self._waiting = [action * ~began for action in self._waiting]
        return tensordict_reset
