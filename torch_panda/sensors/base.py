"""Base classes of sensors, and the entries that they observe."""

from abc import ABC, abstractmethod
from collections.abc import Collection, Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from torch_panda.arguments import Configured
from torch_panda.bullet import PhysicsClient, VectorSimulation
from torch_panda.rendering import VectorRenderer
from torch_panda.robots import Robot


class Entry(NamedTuple):
    """An observed entry of one environment.

    ``high`` is the largest value of an entry whose smallest value is 0; None means that
    the entry has no bounds.
    """

    shape: tuple[int, ...]
    dtype: torch.dtype
    high: float | None = None


class Observer(Protocol):
    """Observes entries of all n environments of a simulation.

    Attributes:
        entries: The entries of one environment, by key.
    """

    entries: dict[str, Entry]

    def observe(self) -> dict[str, Tensor]:
        """The present values in all environments, (n, ...) by key, in new tensors."""


class Reading(Observer, Protocol):
    """A sensor in all n environments of a simulation."""

    def after_reset(self, envs: Sequence[int]) -> None:
        """Update the values of environments whose episodes have started."""

    def after_step(self, envs: Sequence[int]) -> None:
        """Update the values of environments that have made a step."""


class Sensor(Configured, ABC):
    """Description of a sensor, which several environments may share.

    `attach` makes the `Reading` that holds the values of one environment batch.
    """

    def check(self, robot: Robot) -> None:
        """Refuse a robot that cannot have this sensor.

        Raises:
            ValueError: The robot cannot have it.
        """

    def build(self, client: PhysicsClient, body: int, robot: Robot) -> None:
        """Prepare one client, in which the robot was built, for the sensor."""

    @abstractmethod
    def attach(
        self, simulation: VectorSimulation, renderer: VectorRenderer, robot: Robot
    ) -> Reading:
        """Make the `Reading` for all environments of a simulation."""


# Keys of an environment's outputs, and keys that torchrl uses.
_ENVIRONMENT_KEYS = {
    "observation", "achieved_goal", "desired_goal", "success", "action", "reward",
    "terminated", "truncated", "done", "next", "_reset", "_step",
}  # fmt: skip


def join_entries(
    observers: Sequence[Observer], reserved: Collection[str]
) -> dict[str, Entry]:
    """Join the entries of all observers.

    Args:
        observers: The observers.
        reserved: Further keys that no observer may use.

    Raises:
        ValueError: Two observers use the same key, or a key is reserved or not text.
    """
    entries: dict[str, Entry] = {}
    for observer in observers:
        for key in observer.entries:
            if not isinstance(key, str):
                raise ValueError(f"the key of an entry must be text, got {key!r}")
        if taken := (_ENVIRONMENT_KEYS | set(reserved)) & observer.entries.keys():
            raise ValueError(
                f"{sorted(taken)} are the environment's own keys: use other keys in "
                "sensors, extra_observation and the task's info"
            )
        if shared := entries.keys() & observer.entries.keys():
            raise ValueError(
                f"{sorted(shared)} are observed twice; give cameras different names, "
                "or rename entries of extra_observation"
            )
        entries |= observer.entries
    return entries
