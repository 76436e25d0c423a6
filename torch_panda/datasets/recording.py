"""Records episodes of the scripted experts as demonstrations."""

from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import AdditiveGaussianModule

import torch_panda
from torch_panda.learning.files import prepare, save


class TensorWriter:
    """Writes all transitions into one file, which `torch.load` reads.

    Args:
        path: of the file.

    Raises:
        OSError: it could not be written.
    """

    def __init__(self, path: Path) -> None:
        prepare(path)
        self.path = path
        self.episodes: list[TensorDictBase] = []

    def add(self, episode: TensorDictBase, seed: int) -> None:
        """Keep an episode."""
        self.episodes.append(episode)

    def close(self) -> str:
        """Ctrl-C leaves the file as it was, or makes the whole of it."""
        demos = join(self.episodes)
        save(self.path, demos.to_dict())
        return str(self.path)


def disturb(
    expert: TensorDictModule, env: torch_panda.RobotTaskEnv, noise_eps: float
) -> TensorDictModuleBase:
    """The expert with noise on its ``action``, which is kept as ``intended``."""
    keep = TensorDictModule(torch.clone, ["action"], ["intended"])
    noise = AdditiveGaussianModule(
        env.action_spec, sigma_init=noise_eps, sigma_end=noise_eps
    )
    return TensorDictSequential(expert, keep, noise)


def play(
    env: torch_panda.RobotTaskEnv,
    expert: TensorDictModuleBase,
    exploration: ExplorationType = ExplorationType.RANDOM,
) -> list[TensorDictBase]:
    """One fresh episode of every environment, each with its transitions (steps,)."""
    with torch.no_grad(), set_exploration_type(exploration):
        rollout = env.rollout(
            env.max_episode_steps,
            expert,
            break_when_any_done=False,
            break_when_all_done=True,
        )
    ended = rollout["next", "done"].squeeze(-1)
    lengths = (ended.cumsum(1) == 0).sum(1) + 1
    return [row[:length] for row, length in zip(rollout, lengths.tolist(), strict=True)]


def join(episodes: list[TensorDictBase]) -> TensorDictBase:
    """The transitions of all episodes, one after the other, numbered by episode."""
    transitions = TensorDict.cat(episodes)
    # The key by which collectors, and HindsightRelabel, tell trajectories apart.
    lengths = torch.tensor([len(episode) for episode in episodes])
    numbers = torch.arange(len(episodes)).repeat_interleave(lengths)
    transitions["collector", "traj_ids"] = numbers
    return transitions
