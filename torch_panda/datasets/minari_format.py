"""Minari's format (https://minari.farama.org): one folder holds all data sets by id."""

import shutil
import warnings
from copy import deepcopy
from importlib.metadata import version
from pathlib import Path

import gymnasium
import minari
import numpy as np
import torch
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_dataset import parse_dataset_id
from minari.storage import get_dataset_path
from tensordict import TensorDict, TensorDictBase

from torch_panda import RobotTaskEnv

OBSERVED = ("observation", "achieved_goal", "desired_goal")
# Description of the policy that chose the actions, for each kind of data.
ALGORITHMS = {
    "expert": "the scripted expert of torch_panda.experts",
    "noisy": "the scripted expert of torch_panda.experts, with noise",
    "play": "the scripted expert of torch_panda.experts, pursuing goal after goal",
    "random": "uniformly random actions",
}


class Writer:
    """Collects episodes, and writes the data set when it is closed.

    Args:
        out: Id of the data set, such as "panda/push-expert-v0".
        env_id: Id of the environment that was recorded.
        env: The environment, for the options that its id does not fix.
        kind: "expert", or a kind of `torch_panda.datasets.generate`.

    Raises:
        ValueError: The id is invalid, or a data set with this id exists.
    """

    def __init__(self, out: Path, env_id: str, env: RobotTaskEnv, kind: str) -> None:
        self.folder = find_folder(out)
        self.dataset_id, self.env_id, self.kind = out.as_posix(), env_id, kind
        self.spec = deepcopy(gymnasium.spec(f"torch_panda/{env_id}"))
        self.spec.max_episode_steps = env.max_episode_steps
        self.spec.kwargs["terminate_on_success"] = env.terminate_on_success
        self.episodes: list[EpisodeBuffer] = []

    def add(self, episode: TensorDictBase, seed: int) -> None:
        """Add an episode.

        Observations and success have one more entry than actions, for the first state.
        """
        success = torch.cat((episode["success"][:1], episode["next", "success"]))
        self.episodes.append(
            EpisodeBuffer(
                id=len(self.episodes),
                seed=seed,
                observations={key: states(episode, key) for key in OBSERVED},
                actions=episode["action"].numpy(),
                rewards=after(episode, "reward"),
                terminations=after(episode, "terminated"),
                truncations=after(episode, "truncated"),
                infos={"is_success": success.squeeze(-1).numpy()},
            )
        )

    def close(self) -> str:
        """Write the data set. An error or Ctrl-C leaves no incomplete data set."""
        try:
            self._write()
        except BaseException:
            shutil.rmtree(self.folder, ignore_errors=True)
            raise
        return f"minari.load_dataset({self.dataset_id!r}), in {self.folder}"

    def _write(self) -> None:
        with warnings.catch_warnings():
            # Minari warns of missing metadata (author, e-mail, evaluation environment),
            # and Gymnasium that -v1 is older than -v3.
            warnings.filterwarnings("ignore", "`.*` is set to None")
            warnings.filterwarnings("ignore", ".*is out of date")
            minari.create_dataset_from_buffers(
                self.dataset_id,
                self.episodes,
                env=self.spec,
                algorithm_name=ALGORITHMS[self.kind],
                description=f"{self.env_id}: import torch_panda before "
                "recover_environment(); reset(seed=...) with the seed of an episode "
                "starts it again",
                requirements=[f"torch_panda=={version('torch_panda')}"],
                data_format="hdf5",
            )


def find_folder(out: Path) -> Path:
    """The folder of a new data set with the id ``out``.

    Raises:
        ValueError: The id is invalid, or a data set with this id exists.
    """
    dataset_id = out.as_posix()
    try:
        parse_dataset_id(dataset_id)
    except (ValueError, TypeError):  # TypeError: without a version
        raise ValueError(
            f"{dataset_id!r} is not an id of a Minari data set: it must end in a "
            "version, and a namespace must have at least two characters, as in "
            "panda/push-expert-v0"
        ) from None
    folder = Path(get_dataset_path(dataset_id))
    if folder.exists():
        raise ValueError(f"the data set {dataset_id} exists already: choose another id")
    return folder


def read(path: Path) -> TensorDict:
    """Read the transitions of a data set's folder; see `FormatModule.read`."""
    episodes = []
    for episode in minari.MinariDataset(path / "data").iterate_episodes():
        terminated = column(episode.terminations)
        done = terminated | column(episode.truncations)
        data = {
            "action": torch.as_tensor(episode.actions),
            ("collector", "traj_ids"): torch.full((len(done),), int(episode.id)),
            ("next", "reward"): column(episode.rewards).float(),
            ("next", "terminated"): terminated,
            ("next", "done"): done,
        }
        for key in OBSERVED:
            values = torch.as_tensor(episode.observations[key])
            data[key], data["next", key] = values[:-1], values[1:]
        # The goal of a step, even if the next step pursues another one.
        data["next", "desired_goal"] = data["desired_goal"]
        episodes.append(TensorDict(data, [len(done)]))
    return TensorDict.cat(episodes)


def read_env_id(path: Path) -> str | None:
    """Read the id of the recorded environment; see `FormatModule.read_env_id`."""
    spec = minari.MinariDataset(path / "data").env_spec
    return None if spec is None else spec.id.removeprefix("torch_panda/")


def states(episode: TensorDictBase, key: str) -> np.ndarray:
    """The values of an entry in all states of an episode, (steps + 1, ...)."""
    return torch.cat((episode[key], episode["next", key][-1:])).numpy()


def after(episode: TensorDictBase, key: str) -> np.ndarray:
    """The values of an entry after each step, (steps,)."""
    return episode["next", key].squeeze(-1).numpy()


def column(values: np.ndarray) -> torch.Tensor:
    """Reshape (n,) to (n, 1)."""
    return torch.as_tensor(values).unsqueeze(-1)
