"""Transitions of an expert, to learn from before and beside one's own."""

from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase

from torch_panda import RobotTaskEnv
from torch_panda.datasets.formats import format_of, load_format
from torch_panda.learning import files
from torch_panda.learning.buffers import STORED_KEYS

OTHER_REWARDS = 0.01  # of all, at most


def read_demos(path: Path, env: RobotTaskEnv) -> TensorDictBase:
    """Transitions (n,) of whole episodes.

    Args:
        path: a file of `record_demos.py`, or the folder of a data set; see `formats`.
        env: the environment that they are for.

    Raises:
        ValueError: it holds none, or none of such an environment: sizes or rewards
            differ.
    """
    if not path.exists():
        raise ValueError(
            f"there is no {path}: demonstrations are a file of record_demos.py, or the "
            "folder of a data set (Minari's is ~/.minari/datasets/ and its id)"
        )
    if (name := format_of(path)) is not None:
        demos = load_format(name).read(path).select(*STORED_KEYS)
    else:
        content = files.read(path, "demonstrations", STORED_KEYS)
        try:
            demos = TensorDict(content, [len(content["action"])]).select(*STORED_KEYS)
        except (RuntimeError, TypeError) as error:  # other lengths, or no tensors
            raise ValueError(f"{path} does not hold demonstrations: {error}") from None
    if not len(demos):
        raise ValueError(f"{path} holds no transitions")
    for key in ("observation", "action", "desired_goal"):
        expected = env.full_observation_spec.get(key, None)
        size = (env.action_spec if expected is None else expected).shape[-1]
        if demos[key].shape[-1] != size:
            raise ValueError(
                f"{path}: {key} has size {demos[key].shape[-1]}, the task's has {size}"
            )
    check_rewards(path, demos, env)
    # What is beyond the environment clips, too.
    demos["action"] = demos["action"].clamp(-1.0, 1.0)
    return demos.to(env.device)


def check_rewards(path: Path, demos: TensorDictBase, env: RobotTaskEnv) -> None:
    """Make sure that demonstrations were rewarded as the task rewards.

    Raises:
        ValueError: they were not.
    """
    after = demos["next"]
    expected = env.compute_reward(after["achieved_goal"], demos["desired_goal"])
    found = after["reward"].to(expected)
    # A rounded goal at the edge of success may count otherwise.
    other = ~torch.isclose(found, expected, rtol=1e-3, atol=1e-3)
    if other.double().mean() > OTHER_REWARDS:
        k = int(other.flatten().nonzero()[0])
        raise ValueError(
            f"{path}: {other.double().mean():.0%} of the rewards are not the task's, "
            f"the first is {float(found[k]):g} instead of {float(expected[k]):g}: were "
            "they recorded with another id or other options?"
        )
