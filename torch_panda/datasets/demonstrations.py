"""Reads demonstrations: transitions of an expert from which an agent learns."""

from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase

from torch_panda import RobotTaskEnv
from torch_panda.datasets.formats import format_of, load_format
from torch_panda.learning import files
from torch_panda.learning.buffers import STORED_KEYS

# Fraction of the stored rewards that may differ from those of the task. Rounding a goal
# near the success threshold can change its reward.
DIFFERENT_REWARDS = 0.01


def read_demos(path: Path, env: RobotTaskEnv) -> TensorDictBase:
    """Read demonstrations and check that they fit an environment.

    Args:
        path: File that ``python -m torch_panda record`` wrote, or the folder of a data
            set in Minari's or LeRobot's format.
        env: Environment of the task that was demonstrated.

    Returns:
        Transitions (n,) of whole episodes, on the device of the environment. Actions
        are clipped to [-1, 1], as the environment clips them.

    Raises:
        ValueError: The path holds no demonstrations, or their sizes or rewards differ
            from those of the environment.
    """
    if not path.exists():
        raise ValueError(
            f"there is no file or folder {path}: demonstrations are a file that "
            "`python -m torch_panda record` wrote, or the folder of a data set "
            "(Minari's is ~/.minari/datasets/ followed by its id)"
        )
    try:
        if (name := format_of(path)) is not None:
            demos = load_format(name).read(path)
        else:
            keys = STORED_KEYS
            content = files.read(path, "demonstrations", keys, finite=keys)
            # The batch shape is (n,), or [episodes, steps] for the data of `generate`.
            demos = TensorDict(content, content["action"].shape[:-1])
        demos = demos.select(*STORED_KEYS)
    except (AttributeError, LookupError, RuntimeError, TypeError) as error:
        # Entries are missing or are not tensors, or their lengths differ.
        raise ValueError(f"{path} does not hold demonstrations: {error}") from None
    if not len(demos):
        raise ValueError(f"{path} holds no transitions")
    demos = demos.reshape(-1)
    for key in ("observation", "action", "desired_goal"):
        expected = env.full_observation_spec.get(key, None)
        size = (env.action_spec if expected is None else expected).shape[-1]
        if demos[key].shape[-1] != size:
            raise ValueError(
                f"{path} is for another task: its {key} has size "
                f"{demos[key].shape[-1]}, that of the environment has size {size}"
            )
    _check_rewards(path, demos, env)
    demos["action"] = demos["action"].clamp(-1.0, 1.0)
    return demos.to(env.device)


def _check_rewards(path: Path, demos: TensorDictBase, env: RobotTaskEnv) -> None:
    """Check that the stored rewards are those that the task computes.

    Raises:
        ValueError: More than `DIFFERENT_REWARDS` of them differ.
    """
    achieved_goal = demos["next", "achieved_goal"]
    expected = env.compute_reward(achieved_goal, demos["desired_goal"])
    stored = demos["next", "reward"].to(expected)
    differs = ~torch.isclose(stored, expected, rtol=1e-3, atol=1e-3)
    if differs.double().mean() > DIFFERENT_REWARDS:
        k = int(differs.flatten().nonzero()[0])
        raise ValueError(
            f"{path}: {differs.double().mean():.0%} of the rewards differ from those "
            f"of the task; the first is {float(stored[k]):g} instead of "
            f"{float(expected[k]):g}. Record the demonstrations with the same id and "
            "options"
        )
