"""What an environment can observe beyond the state of robot and task."""

from abc import ABC, abstractmethod
from collections.abc import Collection, Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from torch_panda.bullet import PhysicsClient, VectorSimulation
from torch_panda.rendering import VectorRenderer
from torch_panda.robots import Robot


class Entry(NamedTuple):
    """An entry of what is observed of one environment.

    Attributes:
        shape: its shape.
        dtype: its dtype.
        high: the largest value, where 0 is the smallest; None: there are no bounds.
    """

    shape: tuple[int, ...]
    dtype: torch.dtype
    high: float | None = None


class Reading(Protocol):
    """What a sensor says of the n environments of a simulation."""

    entries: dict[str, Entry]

    def after_reset(self, envs: Sequence[int]) -> None:
        """Episodes have started in these environments."""

    def after_step(self, envs: Sequence[int]) -> None:
        """Time has passed in these environments."""

    def observe(self) -> dict[str, Tensor]:
        """What is sensed now in all environments, by entry: (n, ...), new tensors."""


class Sensor(ABC):
    """A sensor, as environments are given it: what it observes, and nothing else.

    One description serves several environments; what it reads in one of them is a
    `Reading`.
    """

    def check(self, robot: Robot) -> None:  # noqa: B027 (most sensors fit all robots)
        """Make sure that a robot can have this sensor.

        Raises:
            ValueError: it cannot.
        """

    def build(self, client: PhysicsClient, body: int, robot: Robot) -> None:  # noqa: B027 (most need nothing)
        """Add to a client, in which the robot is ``body``, what the sensor needs."""

    @abstractmethod
    def attach(
        self, simulation: VectorSimulation, renderer: VectorRenderer, robot: Robot
    ) -> Reading:
        """Read the sensor in all environments of a simulation."""


class Observer(Protocol):
    """What observes something beside the state of robot and task."""

    entries: dict[str, Entry]

    def observe(self) -> dict[str, Tensor]:
        """What is observed now in all environments, by entry: (n, ...), new tensors."""


# What an environment observes and returns in any case, and torchrl's.
_OWN = {"observation", "achieved_goal", "desired_goal", "success", "action", "reward"}
_OWN |= {"terminated", "truncated", "done", "next", "_reset", "_step"}


def join_entries(
    observers: Sequence[Observer], reserved: Collection[str] = ()
) -> dict[str, Entry]:
    """The entries of all observers.

    Args:
        observers: what observes.
        reserved: names that have another meaning.

    Raises:
        ValueError: two observe the same, or one what the environment does; or a name is
            reserved, or no text.
    """
    entries: dict[str, Entry] = {}
    for observer in observers:
        for key in observer.entries:
            if not isinstance(key, str):
                raise ValueError(f"the name of an entry must be text, got {key!r}")
        if own := (_OWN | set(reserved)) & observer.entries.keys():
            raise ValueError(f"{sorted(own)} are the environment's own, not a sensor's")
        if twice := entries.keys() & observer.entries.keys():
            raise ValueError(f"two sensors observe {sorted(twice)}")
        entries |= observer.entries
    return entries
