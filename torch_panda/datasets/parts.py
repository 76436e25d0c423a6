"""A folder that keeps the parts of a data set until all of them are generated."""

import json
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path

from tensordict import TensorDict, TensorDictBase

from torch_panda.learning import files
from torch_panda.learning.files.run_files import check_same

RECIPE = "recipe.json"  # file of the options that determine the data


class Parts:
    """The folder of the finished parts. A file's name is the id of its first episode.

    Args:
        folder: The folder.
        recipe: Options that determine the data, in the types that JSON has.
        resume: Whether to continue with the parts that the folder holds.

    Raises:
        ValueError: The folder holds no parts to resume, parts of another recipe, or
            parts although ``resume`` is false.
    """

    def __init__(
        self, folder: Path, recipe: Mapping[str, object], *, resume: bool
    ) -> None:
        self.folder, self._recipe = folder, recipe
        self._is_new = not resume
        file = folder / RECIPE
        if resume:
            if not file.exists():
                raise ValueError(
                    f"there is no data set to resume in {folder}: start without "
                    "--resume"
                )
            check_same(folder, json.loads(file.read_text()), recipe)
        elif file.exists():
            raise ValueError(
                f"{folder} holds a part of a data set: continue with --resume, or "
                "remove the folder"
            )

    @property
    def num_episodes(self) -> int:
        """Number of episodes in all parts."""
        paths = self._paths()
        if not paths:
            return 0
        return int(paths[-1].stem) + len(_read(paths[-1]))

    def add(self, part: TensorDictBase) -> None:
        """Save a part [episodes, steps]. The first part creates the folder.

        Raises:
            ValueError: Another process has begun a data set in the folder meanwhile.
            OSError: The file cannot be written.
        """
        if self._is_new:
            if (self.folder / RECIPE).exists():
                raise ValueError(
                    f"another process writes into {self.folder}: stop that process "
                    "first, or choose another --out"
                )
            self.folder.mkdir(parents=True, exist_ok=True)
            files.save_text(self.folder / RECIPE, json.dumps(self._recipe, indent=2))
            self._is_new = False
        first = int(part["collector", "traj_ids"][0, 0])
        files.save(self.folder / f"{first:08d}.pt", part.to_dict())

    def __iter__(self) -> Iterator[TensorDict]:
        """The parts [episodes, steps] in the order of their episodes."""
        return map(_read, self._paths())

    def remove(self) -> None:
        """Remove the folder."""
        shutil.rmtree(self.folder)

    def _paths(self) -> list[Path]:
        return sorted(self.folder.glob("*.pt"))


def _read(path: Path) -> TensorDict:
    content = files.read(path, "a part of a data set", ("action", "next"))
    return TensorDict(content).auto_batch_size_(2)
