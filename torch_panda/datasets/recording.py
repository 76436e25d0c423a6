"""Records episodes of scripted experts as demonstrations."""

from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torchrl.envs.utils import ExplorationType
from torchrl.modules import AdditiveGaussianModule

import torch_panda
from torch_panda.learning.evaluation.rollouts import play_episodes
from torch_panda.learning.files import prepare, save


class TensorWriter:
    """Writes all transitions into one file that `torch.load` reads.

    Args:
        path: Path of the file.

    Raises:
        OSError: The file cannot be written.
    """

    def __init__(self, path: Path) -> None:
        prepare(path)
        self.path = path
        self.episodes: list[TensorDictBase] = []

    def add(self, episode: TensorDictBase, seed: int) -> None:
        """Keep an episode until the file is written. The file does not hold seeds."""
        self.episodes.append(episode)

    def close(self) -> str:
        """Write the file. If Ctrl-C interrupts this, there is no incomplete file."""
        demos = TensorDict.cat(self.episodes)
        lengths = torch.tensor([len(episode) for episode in self.episodes])
        episode_ids = torch.arange(len(lengths)).repeat_interleave(lengths)
        demos["collector", "traj_ids"] = episode_ids
        save(self.path, demos.to_dict())
        return str(self.path)


def add_noise(
    expert: TensorDictModuleBase, env: torch_panda.RobotTaskEnv, noise_eps: float
) -> TensorDictModuleBase:
    """Add Gaussian noise to the actions of an expert.

    Args:
        expert: Policy that writes ``action``.
        env: Environment, for the shape and limits of actions.
        noise_eps: Standard deviation of the noise.

    Returns:
        A policy that writes the noisy ``action``, and the expert's own action under
        ``intended``.
    """
    keep = TensorDictModule(torch.clone, ["action"], ["intended"])
    noise = AdditiveGaussianModule(
        env.action_spec, sigma_init=noise_eps, sigma_end=noise_eps
    )
    # The overloads of TensorDictSequential lack modules as arguments.
    return TensorDictSequential(expert, keep, noise)  # type: ignore[call-overload]


def play(
    env: torch_panda.RobotTaskEnv, expert: TensorDictModuleBase
) -> list[TensorDictBase]:
    """Play one new episode in every environment.

    Args:
        env: Batched environment.
        expert: Policy that writes ``action``. It may add noise.

    Returns:
        The episodes, each with its transitions (steps,).
    """
    # mypy takes the members of this enum for strings.
    exploration = ExplorationType.RANDOM
    rollout, lengths = play_episodes(env, expert, exploration)  # type: ignore[arg-type]
    return [row[:length] for row, length in zip(rollout, lengths.tolist(), strict=True)]
