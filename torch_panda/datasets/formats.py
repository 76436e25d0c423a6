"""Demonstrations as data sets that other tools read, and back as our transitions.

In these formats each episode has its seed: ``reset(seed=...)`` of
`torch_panda.gymnasium_envs.GoalEnv` starts it again.
"""

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Literal, Protocol

from tensordict import TensorDict, TensorDictBase

from torch_panda import RobotTaskEnv

Format = Literal["minari", "lerobot"]

MARKS: dict[Format, str] = {"minari": "data/metadata.json", "lerobot": "meta/info.json"}


class Writer(Protocol):
    """Writes a data set."""

    def add(self, episode: TensorDictBase, seed: int) -> None:
        """Add an episode's transitions (steps,), and the seed that started it."""

    def close(self) -> str:
        """Finish the data set, and say where it is and how it is read."""


class FormatModule(Protocol):
    """What a module of this package offers."""

    def open_writer(self, out: Path, env_id: str, env: RobotTaskEnv) -> Writer:
        """Begin a data set, of transitions of this environment."""

    def read(self, path: Path) -> TensorDict:
        """The transitions of a data set's folder, with our keys, (n,)."""


def load_format(name: Format) -> FormatModule:
    """The module that writes and reads a format.

    Raises:
        ValueError: its library is not installed.
    """
    if find_spec(name) is None:
        raise ValueError(
            f"{name} is not installed: examples/README.md, under Data sets for other "
            "tools, says how to"
        )
    module: FormatModule = import_module(f"torch_panda.datasets.{name}_format")
    return module


def format_of(path: Path) -> Format | None:
    """The format of a data set's folder; None: it is no such folder."""
    return next((name for name, mark in MARKS.items() if (path / mark).is_file()), None)
