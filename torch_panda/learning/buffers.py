"""Replay buffers with hindsight, and the choice of the transitions to store."""

from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, pad
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Transform

from torch_panda.learning.environments import GoalEnv
from torch_panda.learning.environments.geometry import AXES, split_goal
from torch_panda.tasks.base import RewardFunction
from torch_panda.transforms import HindsightRelabel

Hindsight = Literal["relabel", "parts", "geometric", "none"]

# Both numbers are from the panda-gym paper (arXiv 2106.13687).
K = 4  # hindsight goals per original goal; the HER paper's k
BUFFER_SIZE = 1_000_000  # capacity
# Steps at the start of an episode in which Slide's puck falls onto the table. They do
# not count as motion.
SETTLING_STEPS = 4
# An achieved goal has moved if one of its numbers changed by more than this: [m] for
# positions, without unit for quaternions.
MIN_MOTION = 0.01
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


class ResumableReplayBuffer(TensorDictReplayBuffer):
    """A replay buffer that also loads the state of another device or smaller buffer."""

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the state of a buffer whose capacity is at most that of this one."""
        storage = state_dict["_storage"]
        if storage["initialized"]:
            rows = TensorDict().load_state_dict(storage["_storage"], strict=False)
            rows = rows.to(self.storage.device)
            padded = pad(rows, [0, self.storage.max_size - len(rows)])
            storage = {**storage, "_storage": padded.state_dict()}
        super().load_state_dict({**state_dict, "_storage": storage})


class PartRewards(Transform):
    """Replaces sampled rewards (n, 1) by those of each part of the goal, (n, parts).

    The reward of a part is that of a goal whose other parts are achieved.

    Args:
        compute_reward: The reward of achieved and desired goal, (n, 1).
    """

    def __init__(self, compute_reward: RewardFunction) -> None:
        super().__init__()
        self.compute_reward = compute_reward

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the rewards of sampled transitions."""
        achieved = tensordict["next", "achieved_goal"]
        goal = tensordict["desired_goal"]
        rewards = []
        for part in split_goal(goal.shape[-1]):
            goal_of_part = achieved.clone()
            goal_of_part[..., part] = goal[..., part]
            rewards.append(self.compute_reward(achieved, goal_of_part))
        return tensordict.set(("next", "reward"), torch.cat(rewards, -1))


def make_buffer(
    env: GoalEnv,
    capacity: int,
    *,
    her: Hindsight = "relabel",
    desired_ratio: float = 0.0,
    discount: float = 0.99,
    seed: int | None = None,
) -> TensorDictReplayBuffer:
    """Make a replay buffer with hindsight, on the device of the environment.

    Args:
        env: Environment whose transitions will be stored.
        capacity: Number of transitions. A number above `BUFFER_SIZE` is reduced to it.
        her: "relabel" gives a fraction K / (K + 1) of the sampled transitions a
            hindsight goal. "parts" draws for each object separately whether its part of
            the goal is relabelled. The same fraction of transitions has all parts
            relabelled. "geometric" gives every sampled transition the goal achieved k
            steps later in its episode, with probability proportional to discount**k.
            "none" keeps the original goals.
        desired_ratio: Fraction of the hindsight goals that are desired goals of random
            transitions, or with "parts" contain a part of one. The rest are goals
            achieved later in the same episode.
        discount: Discount of "geometric".
        seed: Seed of the choice of goals.

    Raises:
        ValueError: ``her`` does not fit the task.
    """
    parts = split_goal(env.observation_spec["desired_goal"].shape[-1])
    if her == "parts" and len(parts) < 2:
        raise ValueError(
            "--her parts needs goals of several objects, such as those of Stack: pass "
            "--her relabel"
        )
    # Each part is drawn on its own. The roots make it as likely for all parts together
    # to be relabelled, and to be achieved later, as for a whole goal.
    root = 1 / len(parts) if her == "parts" else 1.0
    later_ratio = (1 - desired_ratio) ** root
    later = "geometric" if her == "geometric" else "future"
    weights = {later: later_ratio, "desired": 1 - later_ratio}
    strategy = {name: weight for name, weight in weights.items() if weight}
    # `success_fn` is None below, because success is not stored (see `STORED_KEYS`).
    transform = None
    if her != "none":
        transform = HindsightRelabel.from_env(
            env,
            success_fn=None,
            her_ratio=1.0 if her == "geometric" else (K / (K + 1)) ** root,
            strategy=strategy,
            discount=discount,
            goal_parts=(AXES,) * len(parts) if her == "parts" else None,
            seed=seed,
        )
    storage = LazyTensorStorage(min(capacity, BUFFER_SIZE), device=env.device or "cpu")
    return ResumableReplayBuffer(storage=storage, transform=transform)


def has_moved(data: TensorDictBase) -> Tensor:
    """Find the sequences in which the achieved goal changes.

    If no object moves in an episode, all its hindsight goals are achieved from the
    start. Such episodes teach little (doi 10.20517/ir.2023.10, figure 3). A sequence of
    several episodes nearly always counts as changed, because every reset places the
    objects anew.

    Args:
        data: Successive steps of each environment, [num_envs, steps].

    Returns:
        Whether the goal changes in each sequence, (num_envs,) bool.
    """
    goal = data["next", "achieved_goal"]
    goal = goal[:, min(SETTLING_STEPS, goal.shape[1] // 2) :]
    change = (goal - goal[:, :1]).abs()
    return (change > MIN_MOTION).flatten(1).any(1)


def select_sequences(data: TensorDictBase, keep_unmoved: float) -> TensorDictBase:
    """Select the sequences and the entries to store.

    Args:
        data: Successive steps of each environment, [num_envs, steps], from its reset
            on. If success ends episodes, the steps of an environment may belong to
            several episodes.
        keep_unmoved: Probability with which a sequence is kept in which the achieved
            goal does not change (see `has_moved`).

    Returns:
        The n selected sequences, [n, steps], with the entries `STORED_KEYS`.
    """
    # The collector resets all environments before the next batch, so episodes that are
    # still running end here.
    data["next", "done"][:, -1] = True
    data = data.select(*STORED_KEYS)
    if keep_unmoved == 1:
        return data
    is_kept = torch.rand(len(data)) < keep_unmoved
    moved = has_moved(data)
    return data[moved | is_kept.to(moved.device)]  # type: ignore[return-value]  # a TensorDict
