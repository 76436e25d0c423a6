"""Minari's format (https://minari.farama.org): data sets by id, in one folder."""

import warnings
from importlib.metadata import version
from pathlib import Path

import minari
import numpy as np
import torch
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_dataset import parse_dataset_id
from minari.storage import get_dataset_path
from tensordict import TensorDict, TensorDictBase

from torch_panda import RobotTaskEnv

OBSERVED = ("observation", "achieved_goal", "desired_goal")


class MinariWriter:
    """Gathers episodes, and writes them at the end.

    Args:
        dataset_id: such as "panda/push-expert-v0".
        env_id: one of torch_panda.ENV_IDS.

    Raises:
        ValueError: the id is none, or is taken.
    """

    def __init__(self, dataset_id: str, env_id: str) -> None:
        try:
            parse_dataset_id(dataset_id)
        except (ValueError, TypeError):  # TypeError: without a version
            raise ValueError(
                "the id of a data set ends in its version, and a namespace has two "
                f"characters or more, such as panda/push-expert-v0, got {dataset_id!r}"
            ) from None
        if self.folder(dataset_id).exists():
            raise ValueError(f"there is a data set {dataset_id} already")
        self.dataset_id, self.env_id = dataset_id, env_id
        self.episodes: list[EpisodeBuffer] = []

    @staticmethod
    def folder(dataset_id: str) -> Path:
        """Where Minari keeps a data set."""
        return Path(get_dataset_path(dataset_id))

    def add(self, episode: TensorDictBase, seed: int) -> None:
        """Observations and success are those of all states, one more than actions."""
        self.episodes.append(
            EpisodeBuffer(
                id=len(self.episodes),
                seed=seed,
                observations={key: states(episode, key) for key in OBSERVED},
                actions=episode["action"].numpy(),
                rewards=after(episode, "reward"),
                terminations=after(episode, "terminated"),
                truncations=after(episode, "truncated"),
                infos={"is_success": states(episode, "success").squeeze(-1)},
            )
        )

    def close(self) -> str:
        """Write the data set."""
        with warnings.catch_warnings():
            # That there is no author, no address, no second environment; and that a -v1
            # is older than a -v3.
            warnings.filterwarnings("ignore", "`.*` is set to None")
            warnings.filterwarnings("ignore", ".*is out of date")
            minari.create_dataset_from_buffers(
                self.dataset_id,
                self.episodes,
                env=f"torch_panda/{self.env_id}",
                algorithm_name="the scripted expert of examples/experts",
                description=f"{self.env_id}; `import torch_panda` before "
                "recover_environment(); reset(seed=episode's) starts an episode again",
                requirements=[f"torch_panda=={version('torch_panda')}"],
                data_format="hdf5",
            )
        return (
            f"minari.load_dataset({self.dataset_id!r}), "
            f"in {self.folder(self.dataset_id)}"
        )


def open_writer(out: Path, env_id: str, env: RobotTaskEnv) -> MinariWriter:
    """Begin a data set; ``out`` is its id."""
    return MinariWriter(out.as_posix(), env_id)


def read(path: Path) -> TensorDict:
    """The transitions of a data set's folder; see `FormatModule.read`."""
    episodes = []
    for episode in minari.MinariDataset(path / "data").iterate_episodes():
        terminated = column(episode.terminations)
        done = terminated | column(episode.truncations)
        success = column(episode.infos["is_success"])
        data = {
            "action": torch.as_tensor(episode.actions),
            ("collector", "traj_ids"): torch.full((len(done),), int(episode.id)),
            ("next", "reward"): column(episode.rewards).float(),
            ("next", "terminated"): terminated,
            ("next", "done"): done,
            ("next", "success"): success[1:],
        }
        for key in OBSERVED:
            values = torch.as_tensor(episode.observations[key])
            data[key], data["next", key] = values[:-1], values[1:]
        episodes.append(TensorDict(data, [len(done)]))
    return TensorDict.cat(episodes)


def states(episode: TensorDictBase, key: str) -> np.ndarray:
    """An entry of all states of an episode, (steps + 1, ...)."""
    return torch.cat((episode[key][:1], episode["next", key])).numpy()


def after(episode: TensorDictBase, key: str) -> np.ndarray:
    """An entry after each step, (steps,)."""
    return episode["next", key].squeeze(-1).numpy()


def column(values: np.ndarray) -> torch.Tensor:
    """(n,) as (n, 1)."""
    return torch.as_tensor(values).unsqueeze(-1)
