"""The package's own environment with short episodes, for collectors' workers.

A random arm is never twice at the same float position, so a goal says where it is from.
"""

import torch
from tensordict import TensorDict
from torchrl.envs import ParallelEnv

from torch_panda import Panda, Reach, RobotTaskEnv


def reward_fn(achieved: torch.Tensor, desired: torch.Tensor) -> torch.Tensor:
    return Reach().compute_reward(achieved, desired)


def make_env(max_episode_steps: int = 5, num_envs: int | None = 2) -> RobotTaskEnv:
    return RobotTaskEnv(
        robot=Panda(block_gripper=True),
        task=Reach(),
        num_envs=num_envs,
        num_threads=1,
        max_episode_steps=max_episode_steps,
    )


def make_longer() -> RobotTaskEnv:
    return make_env(8)


def make_parallel() -> ParallelEnv:
    return ParallelEnv(2, [make_env, make_longer])


def check_batch(batch: TensorDict, stored: TensorDict) -> torch.Tensor:
    """Asserts that a sampled batch is right, and returns which rows are relabelled."""
    original = stored[batch["index"]]
    goal = batch["desired_goal"]
    mask = (goal != original["desired_goal"]).any(-1)
    assert (batch["next", "desired_goal"][mask] == goal[mask]).all()
    rows = batch[mask]
    reward = reward_fn(rows["next", "achieved_goal"], goal[mask])
    assert (rows["next", "reward"] == reward).all()
    assert (batch[~mask] == original.exclude("hindsight_serial")[~mask]).all()

    same = (goal[mask][:, None] == stored["next", "achieved_goal"]).all(-1)
    assert (same.sum(-1) == 1).all(), "overwritten, or not identifiable"
    source = stored[same.int().argmax(-1)]
    ids = ("collector", "traj_ids")
    assert (source[ids] == rows[ids]).all(), "from another trajectory"
    serial = original["hindsight_serial"][mask]
    assert (source["hindsight_serial"] >= serial).all(), "from the past"
    return mask
