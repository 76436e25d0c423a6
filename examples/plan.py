"""Plan instead of learning: torchrl's cross-entropy method, with Bullet as its model.

python examples/plan.py --env-id PandaPush-v1

Every plan forks the exact state of one environment over many and tries an action
sequence in each; the best ones say where to look for better ones. The first action of
the last plan is taken, then comes the next plan.
"""

from dataclasses import dataclass
from typing import Any

import torch
import tyro
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.modules import CEMPlanner

import torch_panda
from limits import Positive, Seed, Weight, check_limits


@dataclass
class Args:
    """What to solve, and how hard to think."""

    env_id: str = "PandaPush-v1"
    """one of torch_panda.ENV_IDS"""
    episodes: Positive = 5
    """episodes to run"""
    seed: Seed = 0
    """of the episodes and of the plans"""
    num_candidates: Positive = 48
    """action sequences that are tried at once, each in an environment"""
    top_k: Positive = 6
    """how many of them, the best ones, the next ones are drawn around"""
    optim_steps: Positive = 3
    """how often"""
    planning_horizon: Positive = 4
    """actions in a sequence"""
    hold: Positive = 3
    """steps for which each action is taken"""
    approach: Weight = 0.3
    """weight of the hand's distance to what is to be moved, beside the task's"""


class Fork(EnvBase):
    """Environments that go on from any exact state; what a planner takes for a model.

    A rollout begins with the ``state`` of one environment and ``index`` 0.

    Args:
        args: the options.
    """

    def __new__(cls, *args: Any, **kwargs: Any) -> "Fork":  # noqa: ANN401 (torchrl's)
        """Take a batch of any size, as planners need."""
        return super().__new__(cls, *args, _batch_locked=False, **kwargs)

    def __init__(self, args: Args) -> None:
        super().__init__(batch_size=[])
        self.hold, self.approach = args.hold, args.approach
        self.model = torch_panda.make(args.env_id, num_envs=args.num_candidates)
        size = self.model.action_spec.shape[-1:]
        self.action_spec = Bounded(-1.0, 1.0, size)
        self.observation_spec = Composite(index=Unbounded((1,), dtype=torch.int64))
        self.reward_spec = Unbounded((1,))

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        if not tensordict["index"].any():
            self.now = self.model.reset(tensordict["state"], set_state=True)
        reward = torch.zeros(*tensordict.batch_size, 1)
        for _ in range(self.hold):
            action = self.now.set("action", tensordict["action"])
            self.now = self.model.step(action)["next"]
            hand, achieved = self.now["observation"][:, :3], self.now["achieved_goal"]
            reward -= self.model.task.distance(achieved, self.now["desired_goal"])
            reward -= self.approach * (achieved[:, :3] - hand).norm(dim=1, keepdim=True)
        ended = torch.zeros_like(reward, dtype=torch.bool)
        return TensorDict(
            {
                "index": tensordict["index"] + 1,
                "reward": reward,
                "done": ended,
                "terminated": ended.clone(),
            },
            tensordict.batch_size,
        )

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDict:
        return TensorDict({"index": torch.zeros(1, dtype=torch.int64)})

    def _set_seed(self, seed: int | None) -> None:
        """Nothing is drawn here."""


def solve(
    env: torch_panda.RobotTaskEnv, planner: CEMPlanner, args: Args
) -> list[tuple[float, bool]]:
    """Plan and act for an episode of an unbatched environment.

    Returns:
        After every action, the distance from the goal and whether that is success.
    """
    td, found = env.reset(), []
    while not td["done"]:
        state = env.get_state(exact=True)
        start = {"state": state, "index": torch.zeros(1, dtype=torch.int64)}
        action = planner(TensorDict(start))["action"]
        for _ in range(args.hold):
            if not td["done"]:
                td = env.step(td.set("action", action))["next"]
        distance = env.task.distance(td["achieved_goal"], td["desired_goal"])
        found.append((distance.item(), bool(td["success"])))
    return found


def main(args: Args) -> None:
    """Run the episodes and print how they end."""
    try:
        check_limits(args)
        env = torch_panda.make(args.env_id, seed=args.seed)
        fork = Fork(args)
    except ValueError as error:
        raise SystemExit(str(error)) from None
    torch.manual_seed(args.seed)
    planner = CEMPlanner(
        fork, args.planning_horizon, args.optim_steps, args.num_candidates, args.top_k
    )
    with env, fork.model, torch.no_grad():
        for episode in range(args.episodes):
            found = solve(env, planner, args)
            distance, success = found[-1]
            print(f"episode {episode}: success {success}, distance {distance:.3f}")


if __name__ == "__main__":
    main(tyro.cli(Args))
