"""Seeds of episodes."""

import secrets
from collections.abc import Mapping
from typing import Any

import numpy as np

from torch_panda.checks import check_seed


class EpisodeSeeds:
    """Random generators by (seed, environment, episode number).

    Attributes:
        seed: The seed of the constructor or of the last `restart`. None means that the
            seed was drawn from the operating system.
    """

    def __init__(self, num_envs: int, seed: int | None) -> None:
        self.seed = seed
        self._streams: list[tuple[int, int]] = []  # (seed, index) by environment
        self._episodes = [0] * num_envs
        self.restart(seed)

    def restart(self, seed: int | None) -> None:
        """Restart the sequence of episodes of all environments.

        Raises:
            ValueError: The seed is negative.
            TypeError: The seed is not an integer.
        """
        number = secrets.randbits(63) if seed is None else check_seed(seed)
        self.seed = None if seed is None else number
        self._streams = [(number, env) for env in range(len(self._episodes))]
        self._episodes = [0] * len(self._episodes)

    def restart_one(self, env: int, seed: int) -> None:
        """Seed one environment; see `RobotTaskEnv.set_env_seed`.

        Raises:
            ValueError: The index is out of range, or the seed is negative.
            TypeError: The seed is not an integer.
        """
        if not 0 <= env < len(self._episodes):
            raise ValueError(
                f"env must be from 0 to {len(self._episodes) - 1}, got {env}"
            )
        self._streams[env] = (check_seed(seed), 0)
        self._episodes[env] = 0

    def next_generator(self, env: int) -> np.random.Generator:
        """The random generator of an environment's next episode."""
        generator = np.random.default_rng((*self._streams[env], self._episodes[env]))
        self._episodes[env] += 1
        return generator

    def physics_seed(self, env: int) -> np.random.SeedSequence:
        """The seed of the physics of the last episode for which `next_generator` ran.

        Goals and objects are drawn from that generator. This seed starts a different
        stream, so that randomized physics do not change the drawn goals and objects.
        """
        episode = (*self._streams[env], self._episodes[env] - 1)
        return np.random.SeedSequence(episode, spawn_key=(1,))

    def state(self) -> dict[str, Any]:
        """Seeds and episode numbers as plain numbers and lists, for `load`."""
        return {
            "seed": self.seed,
            "streams": [list(stream) for stream in self._streams],
            "episodes": list(self._episodes),
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Continue with the seeds and episode numbers that `state` returned.

        Raises:
            ValueError: The state belongs to a different number of environments.
        """
        streams, episodes = state["streams"], state["episodes"]
        if len(episodes) != len(self._episodes):
            raise ValueError(
                f"the state_dict holds {len(episodes)} environments, but this one has "
                f"{len(self._episodes)}: make it with num_envs={len(episodes)}"
            )
        self.seed = state["seed"]
        self._streams = [(seed, index) for seed, index in streams]
        self._episodes = list(episodes)
