"""Formats of data sets of other libraries, and the interface of their modules.

These formats store the seed of each episode. With this seed, ``reset(seed=...)`` of
`torch_panda.gymnasium_envs.GoalEnv` starts the same episode.
"""

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Literal, Protocol

from tensordict import TensorDict, TensorDictBase

from torch_panda import RobotTaskEnv
from torch_panda.extras import install_command

Format = Literal["minari", "lerobot"]

# A file that every data set of a format has in its folder.
_MARKER_FILES: dict[Format, str] = {
    "minari": "data/metadata.json",
    "lerobot": "meta/info.json",
}


class Writer(Protocol):
    """Writes a data set, episode after episode."""

    def add(self, episode: TensorDictBase, seed: int) -> None:
        """Add an episode.

        Args:
            episode: Its transitions, (steps,).
            seed: Seed of the episode.
        """

    def close(self) -> str:
        """Finish the data set, and return a text that says how to read it."""


class FormatModule(Protocol):
    """Interface of the modules ``minari_format`` and ``lerobot_format``."""

    Writer: Callable[[Path, str, RobotTaskEnv, str], Writer]
    """Starts a data set of transitions. Arguments: folder or id of the data set, id of
    the environment, the environment, and "expert" or a kind of
    `torch_panda.datasets.generate`."""

    def read(self, path: Path) -> TensorDict:
        """Read the transitions (n,) of a data set's folder, with torch_panda's keys.

        The success is not read, because other libraries' scripts rarely store it.
        """

    def read_env_id(self, path: Path) -> str | None:
        """Read the id of the recorded environment, without Gymnasium's namespace.

        None means that the data set does not name it.
        """


def load_format(name: Format) -> FormatModule:
    """Import the module that writes and reads a format.

    Raises:
        ValueError: The library of the format is not installed.
    """
    if find_spec(name) is None:
        raise ValueError(f"{name} is not installed: {install_command(name)}")
    module: FormatModule = import_module(f"torch_panda.datasets.{name}_format")
    return module


def format_of(path: Path) -> Format | None:
    """Return the format of a data set's folder, or None for another folder."""
    for name, file in _MARKER_FILES.items():
        if (path / file).is_file():
            return name
    return None
