"""Rollouts of whole episodes in a batch of environments."""

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torch_panda.envs import RobotTaskEnv
from torch_panda.learning.environments import GoalEnv

Policy = Callable[[TensorDictBase], TensorDictBase]


def play_episodes(
    env: GoalEnv,
    policy: Policy,
    exploration: ExplorationType = ExplorationType.DETERMINISTIC,  # type: ignore[assignment]
    start: TensorDictBase | None = None,
) -> tuple[TensorDictBase, Tensor]:
    """Play one new episode in every environment.

    Args:
        env: Batch of environments.
        policy: Policy that writes ``action``.
        exploration: torchrl's exploration type; RANDOM lets the policy add noise.
        start: First observations, as `RobotTaskEnv.reset` returns them; None resets the
            environments.

    Returns:
        Transitions [num_envs, steps], and the number of steps of each episode,
        (num_envs,). Ignore the transitions after the end of an episode.
    """
    with torch.no_grad(), set_exploration_type(exploration):
        rollout = env.rollout(
            env.max_episode_steps,
            policy,
            break_when_any_done=False,
            # An environment of Gymnasium cannot wait for the others, so it goes on.
            break_when_all_done=isinstance(env, RobotTaskEnv),
            auto_reset=start is None,
            tensordict=start,
        )
    has_ended = rollout["next", "done"].squeeze(-1).cumsum(1) > 0
    return rollout, (~has_ended).sum(1) + 1
