"""Reads demonstrations: transitions of an expert from which an agent learns."""

from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase

from torch_panda import RobotTaskEnv
from torch_panda.datasets.formats import format_of, load_format
from torch_panda.learning import files
from torch_panda.learning.buffers import STORED_KEYS
from torch_panda.tasks import Task

# Fraction of the stored rewards that may differ from those of the task. Rounding a goal
# near the success threshold can change its reward.
DIFFERENT_REWARDS = 0.01


def read_demos(path: Path | str, env: RobotTaskEnv) -> TensorDictBase:
    """Read demonstrations and check that they fit an environment.

    Args:
        path: File that ``python -m torch_panda record`` wrote, or another file of a
            nested dict with the entries `STORED_KEYS`; or the folder of a data set in
            Minari's or LeRobot's format.
        env: Environment of the task that was demonstrated.

    Returns:
        Transitions (n,) of whole episodes, on the device of the environment, episode
        after episode: the entries `STORED_KEYS`, and ``("next", "success")`` computed
        from the goals. Floating-point numbers are float32. Actions are clipped to
        [-1, 1], as the environment clips them.

    Raises:
        ValueError: The path holds no demonstrations, they were recorded in an
            environment with another id, their sizes or rewards differ from those of
            the environment, the rows of an episode are not in the order of time, or the
            environment does not observe ``observation``.
    """
    path = Path(path)
    if "observation" not in env.observation_spec:
        raise ValueError(
            "demonstrations need an environment that observes `observation`: make it "
            "without pixels_only"
        )
    if not path.exists():
        raise ValueError(
            f"there is no file or folder {path}: demonstrations are a file that "
            "`python -m torch_panda record` wrote, or the folder of a data set "
            "(Minari's is ~/.minari/datasets/ followed by its id)"
        )
    recorded_id: str | None = None
    try:
        if (name := format_of(path)) is not None:
            data_format = load_format(name)
            demos = data_format.read(path)
            recorded_id = data_format.read_env_id(path)
        else:
            keys = STORED_KEYS
            content = files.read(path, "demonstrations", keys, finite=keys)
            # The batch shape is (n,), or [episodes, steps] for the data of `generate`.
            demos = TensorDict(content, content["action"].shape[:-1])
        demos = demos.select(*STORED_KEYS)
    except (AttributeError, LookupError, RuntimeError, TypeError) as error:
        # Entries are missing or are not tensors, or their lengths differ.
        raise ValueError(f"{path} does not hold demonstrations: {error}") from None
    if None not in (recorded_id, env.env_id) and recorded_id != env.env_id:
        raise ValueError(
            f"{path} was recorded in {recorded_id}, but the environment is "
            f"{env.env_id}: use the data for {recorded_id}, or record data of "
            f"{env.env_id}"
        )
    if not len(demos):
        raise ValueError(f"{path} holds no transitions")
    demos = demos.reshape(-1).apply(lambda x: x.float() if x.is_floating_point() else x)
    for key in ("observation", "action", "desired_goal"):
        spec = env.action_spec if key == "action" else env.observation_spec[key]
        size = spec.shape[-1]
        if demos[key].shape[-1] != size:
            raise ValueError(
                f"{path} is for another task: its {key} has size "
                f"{demos[key].shape[-1]}, that of the environment has size {size}"
            )
    _check_rewards(path, demos, env)
    demos = _sort_episodes(path, demos)
    demos["action"] = demos["action"].clamp(-1.0, 1.0)
    goals = demos["next", "achieved_goal"], demos["desired_goal"]
    demos["next", "success"] = env.is_success(*goals)
    return demos.to(env.device)


def _sort_episodes(path: Path, demos: TensorDictBase) -> TensorDictBase:
    """Make the rows of each episode consecutive, and number the episodes 0, 1, ...

    A collector's batches may hold an episode in several pieces, and merged data sets
    may have the same trajectory ids. So an episode consists of the rows with one id, up
    to a row that is done or that the next row does not continue.

    Raises:
        ValueError: Most rows do not continue the row before them.
    """
    ids = demos["collector", "traj_ids"].reshape(-1)
    order = ids.argsort(stable=True)
    if (order.diff() != 1).any():
        demos, ids = demos[order], ids[order]  # type: ignore[assignment]  # a TensorDict
    ends = demos["next", "done"].reshape(-1) != 0
    ends[:-1] |= ids.diff() != 0
    ends[-1] = True
    expected, following = demos["next", "observation"][:-1], demos["observation"][1:]
    breaks = ~ends[:-1] & (following != expected).any(-1)
    if breaks.sum() > (~ends).sum() / 2:
        raise ValueError(
            f"{path}: the rows of an episode are not in the order of time. In most "
            "rows, the next observation is not the observation of the following row "
            "with the same trajectory id"
        )
    ends[:-1] |= breaks
    numbers = ends.cumsum(0) - ends.long()
    return demos.replace({"collector": {"traj_ids": numbers}})


def _check_rewards(path: Path, demos: TensorDictBase, env: RobotTaskEnv) -> None:
    """Check that the stored rewards are those that the task computes.

    The rewards of `Task.reward` depend on more than goals, so they are not compared.

    Raises:
        ValueError: More than `DIFFERENT_REWARDS` of them differ, or their shape is
            wrong.
    """
    achieved_goal = demos["next", "achieved_goal"]
    expected = env.compute_reward(achieved_goal, demos["desired_goal"])
    stored = demos["next", "reward"].to(expected)
    if stored.shape != expected.shape:
        raise ValueError(
            f"{path}: the rewards must have the shape [..., 1], one for each "
            f"transition, got {tuple(stored.shape)} for {len(demos)} transitions"
        )
    if type(env.task).reward is not Task.reward:
        return
    differs = ~torch.isclose(stored, expected, rtol=1e-3, atol=1e-3)
    if differs.double().mean() > DIFFERENT_REWARDS:
        k = int(differs.flatten().nonzero()[0])
        raise ValueError(
            f"{path}: {differs.double().mean():.0%} of the rewards differ from those "
            f"of the task; the first is {float(stored[k]):g} instead of "
            f"{float(expected[k]):g}. Record the demonstrations with the same id and "
            "options"
        )
