"""What an environment can observe beyond the state of robot and task."""

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor
from torchrl.data import TensorSpec


class Sense(Protocol):
    """A source of observations."""

    def spec(self, batch: torch.Size, device: torch.device) -> dict[str, TensorSpec]:
        """What `observe` gives, for a batch size."""

    def after_reset(self, envs: Sequence[int]) -> None:
        """Episodes have started in these environments."""

    def after_step(self, envs: Sequence[int]) -> None:
        """Time has passed in these environments."""

    def observe(self) -> dict[str, Tensor]:
        """What is sensed now in all n environments: (n, ...), in new tensors."""
