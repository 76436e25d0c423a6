"""The replay buffer, and what goes into it."""

from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from torch_panda.envs import RobotTaskEnv
from torch_panda.transforms import HindsightAugment, HindsightRelabel

Hindsight = Literal["relabel", "parts", "augment", "none"]

K = 4  # hindsight goals to each goal of one's own, as in the panda-gym paper
BUFFER_SIZE = 1_000_000  # transitions of one's own, as in the panda-gym paper
SETTLED = 4  # steps in which Slide's puck, which starts in the air, has fallen
MOVED = 0.01  # [m], or of a quaternion's component
POSITION = 3  # numbers of an object's part of a goal
STORED_KEYS: list[NestedKey] = [
    "observation",
    "desired_goal",
    "action",
    ("collector", "traj_ids"),
    ("next", "observation"),
    ("next", "achieved_goal"),
    ("next", "desired_goal"),
    ("next", "reward"),
    ("next", "terminated"),
    ("next", "done"),
]


def make_buffer(
    env: RobotTaskEnv,
    capacity: int,
    *,
    her: Hindsight = "relabel",
    desired_ratio: float = 0.0,
    seed: int | None = None,
) -> TensorDictReplayBuffer:
    """The replay buffer with the chosen kind of hindsight, on the environment's device.

    Args:
        env: whose transitions will be stored.
        capacity: how many of them, at most BUFFER_SIZE.
        her: relabel K of K + 1 sampled transitions ("relabel"), every object's part of
            their goals on its own ("parts"), store K relabelled copies ("augment"), or
            none.
        desired_ratio: of those, the ratio that get the desired goal of another
            transition; the others get one that their episode reached later.
        seed: of the goals.

    Raises:
        ValueError: the options do not fit each other or the task.
    """
    capacity = min(capacity, BUFFER_SIZE)
    weights = {"future": 1 - desired_ratio, "desired": desired_ratio}
    strategy = {name: weight for name, weight in weights.items() if weight}
    transform: HindsightRelabel | HindsightAugment | None = None
    if her == "augment":
        capacity *= K + 1
        transform = HindsightAugment.from_env(
            env, success_fn=None, k=K, strategy=strategy, seed=seed
        )
    elif her != "none":
        objects, rest = divmod(env.task.goal_dim, POSITION)
        if her == "parts" and (rest or objects < 2):
            raise ValueError(
                "--her parts is for goals of several objects, such as Stack"
            )
        transform = HindsightRelabel.from_env(
            env,
            success_fn=None,
            her_ratio=K / (K + 1),
            strategy=strategy,
            goal_parts=(POSITION,) * objects if her == "parts" else None,
            seed=seed,
        )
    storage = LazyTensorStorage(capacity, device=env.device)
    return TensorDictReplayBuffer(storage=storage, transform=transform)


def moved(data: TensorDictBase) -> Tensor:
    """Which episodes [num_envs, steps] saw their achieved goal change, (num_envs,).

    Every hindsight goal of the others is reached without acting (arXiv 2012.08850).
    """
    goal = data["next", "achieved_goal"]
    goal = goal[:, min(SETTLED, goal.shape[1] // 2) :]
    change = (goal - goal[:, :1]).abs()
    return (change > MOVED).flatten(1).any(1)


def select_episodes(data: TensorDictBase, keep_unmoved: float) -> TensorDictBase:
    """What of whole episodes [num_envs, steps] is stored.

    Args:
        data: ends with the last steps that were taken.
        keep_unmoved: of the episodes in which nothing moved, the ratio to keep.
    """
    # The next batch begins with a reset: an episode that is not over is cut here.
    data["next", "done"][:, -1] = True
    data = data.select(*STORED_KEYS)
    if keep_unmoved == 1:
        return data
    lucky = torch.rand(len(data)) < keep_unmoved
    rows = moved(data) | lucky.to(data.device)
    return data[rows]  # type: ignore[return-value]  # a TensorDict
