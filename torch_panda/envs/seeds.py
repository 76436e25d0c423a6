"""What the random draws of an episode depend on."""

import operator
import secrets
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np


class EpisodeSeeds:
    """Random generators of episodes, by (seed, environment, number of the episode).

    Args:
        num_envs: number of environments.
        seed: None takes one from the operating system, another one in every process.

    Attributes:
        seed: the last one that was given for all.
    """

    def __init__(self, num_envs: int, seed: int | None) -> None:
        self.seed = seed
        self._streams: list[tuple[int, int]] = []  # seed and index
        self._episodes = [0] * num_envs
        self.restart(seed)

    def restart(self, seed: int | None) -> None:
        """Begin all environments' episodes anew.

        Raises:
            ValueError: the seed is negative.
            TypeError: it is no integer.
        """
        number = secrets.randbits(63) if seed is None else check_seed(seed)
        self.seed = None if seed is None else number
        self._streams = [(number, env) for env in range(len(self._episodes))]
        self._episodes = [0] * len(self._episodes)

    def restart_one(self, env: int, seed: int) -> None:
        """Let an environment draw what the first one draws under a seed.

        Raises:
            ValueError: there is no such environment, or the seed is negative.
            TypeError: the seed is no integer.
        """
        if not 0 <= env < len(self._episodes):
            raise ValueError(
                f"env must be from 0 to {len(self._episodes) - 1}, got {env}"
            )
        self._streams[env] = (check_seed(seed), 0)
        self._episodes[env] = 0

    def next_generator(self, env: int) -> np.random.Generator:
        """The generator of an environment's next episode."""
        generator = np.random.default_rng((*self._streams[env], self._episodes[env]))
        self._episodes[env] += 1
        return generator

    def physics_seed(self, env: int) -> np.random.SeedSequence:
        """The seed of the physics of the episode whose generator was the last one.

        Another stream than the generator's: what that draws stays as it is.
        """
        episode = (*self._streams[env], self._episodes[env] - 1)
        return np.random.SeedSequence(episode, spawn_key=(1,))

    def state(self) -> dict[str, Any]:
        """Plain numbers from which `load` goes on."""
        return {
            "seed": self.seed,
            "streams": [list(stream) for stream in self._streams],
            "episodes": list(self._episodes),
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Go on where `state` was asked for.

        Raises:
            ValueError: it is of another number of environments.
        """
        streams, episodes = state["streams"], state["episodes"]
        if len(episodes) != len(self._episodes):
            raise ValueError(
                f"the state is of {len(episodes)} environments, there are "
                f"{len(self._episodes)}"
            )
        self.seed = state["seed"]
        self._streams = [(seed, index) for seed, index in streams]
        self._episodes = list(episodes)


def check_seed(seed: int) -> int:
    """A seed as a plain integer.

    Raises:
        ValueError: it is negative.
        TypeError: it is no integer.
    """
    number = integer("seed", seed)
    if number < 0:
        raise ValueError(f"seed must be a non-negative integer, got {seed}")
    return number


def integer(name: str, value: int) -> int:
    """A plain integer; booleans are none.

    Raises:
        TypeError: the value is no integer.
    """
    if not isinstance(value, bool):  # torch accepts none of these as a size
        with suppress(TypeError):
            return operator.index(value)
    raise TypeError(f"{name} must be an integer, got {value!r}")
