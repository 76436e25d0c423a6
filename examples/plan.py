"""Plan instead of learning: torchrl's cross-entropy method, with Bullet as its model.

python examples/plan.py --episodes 3

Every plan forks the exact state of one environment over many and tries a sequence of
actions in each; the best ones say where to look for better ones. Then the first action
is taken, and comes the next plan.
"""

from dataclasses import dataclass
from typing import Any

import torch
import tyro
from tensordict import TensorDict, TensorDictBase
from torch.nn.functional import normalize
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.modules import CEMPlanner

import torch_panda
from limits import Positive, Seed, Weight, check_limits

BEHIND = 0.04  # [m] from its middle, where the hand pushes a cube


@dataclass
class Args:
    """What to solve, and how hard to think."""

    env_id: str = "PandaPush-v1"
    """one of torch_panda.ENV_IDS"""
    episodes: Positive = 5
    """episodes to run"""
    seed: Seed = 0
    """of the episodes and of the plans"""
    num_candidates: Positive = 32
    """action sequences that are tried at once, each in an environment"""
    top_k: Positive = 5
    """the best ones, around which the next ones are drawn"""
    optim_steps: Positive = 3
    """how often they are drawn for a plan"""
    planning_horizon: Positive = 4
    """actions in a sequence"""
    hold: Positive = 4
    """steps for which each action is taken"""
    action_scale: float = 0.02
    """by how much an action of 1 moves the hand [m]"""
    approach: Weight = 0.5
    """weight of the hand's distance from behind the cube, beside the cube's distance"""


def make(args: Args, **options: Any) -> torch_panda.RobotTaskEnv:  # noqa: ANN401
    """The environments of an id, with actions that are small enough to be tried out."""
    robot_options = {"action_scale": args.action_scale}
    return torch_panda.make(args.env_id, robot_options=robot_options, **options)


class Fork(EnvBase):
    """What a planner takes for a model: environments that go on from an exact state.

    A rollout begins with the ``state`` of one environment and ``index`` 0.
    """

    def __new__(cls, *args: Any, **kwargs: Any) -> "Fork":  # noqa: ANN401, D102
        return super().__new__(cls, *args, _batch_locked=False, **kwargs)

    def __init__(self, args: Args) -> None:
        super().__init__(batch_size=[])
        self.hold, self.approach = args.hold, args.approach
        self.model = make(args, num_envs=args.num_candidates)
        self.action_spec = Bounded(-1.0, 1.0, self.model.action_spec.shape[-1:])
        self.observation_spec = Composite(index=Unbounded((1,), dtype=torch.int64))
        self.reward_spec = Unbounded((1,))

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        if not tensordict["index"].any():
            self.now = self.model.reset(tensordict["state"], set_state=True)
        rewards = []
        for _ in range(self.hold):
            self.now["action"] = tensordict["action"]
            self.now = self.model.step(self.now)["next"]
            goal, achieved = self.now["desired_goal"], self.now["achieved_goal"]
            behind = achieved - BEHIND * normalize(goal - achieved, dim=1)
            far = (behind - self.now["observation"][:, :3]).norm(dim=1, keepdim=True)
            left = self.model.task.distance(achieved, goal)
            rewards.append(-left - self.approach * far)
        reward = torch.stack(rewards).sum(0)
        # The end of an episode is no end of a plan.
        done = torch.zeros_like(reward, dtype=torch.bool)
        ends = {"done": done, "terminated": done.clone()}
        index = tensordict["index"] + 1
        return TensorDict({"index": index, "reward": reward, **ends}, reward.shape[:1])

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDict:
        raise NotImplementedError("a fork starts from a state")

    def _set_seed(self, seed: int | None) -> None:
        """Nothing is drawn here."""


def solve(env: torch_panda.RobotTaskEnv, fork: Fork, args: Args) -> TensorDictBase:
    """Plan and act for an episode of one environment; return its last step."""
    sizes = args.planning_horizon, args.optim_steps, args.num_candidates, args.top_k
    planner = CEMPlanner(fork, *sizes)
    td = env.reset()
    while not td["done"]:
        start = {"state": env.get_state(exact=True), "index": torch.tensor([0])}
        action = planner(TensorDict(start))["action"]
        for _ in range(args.hold):
            if not td["done"]:
                td = env.step(td.set("action", action))["next"]
    return td


def main(args: Args) -> None:
    """Run the episodes and print how they end."""
    try:
        check_limits(args)
        env, fork = make(args, seed=args.seed), Fork(args)
    except ValueError as error:
        raise SystemExit(str(error)) from None
    torch.manual_seed(args.seed)
    with env, fork.model, torch.no_grad():
        for episode in range(args.episodes):
            end = solve(env, fork, args)
            left = env.task.distance(end["achieved_goal"], end["desired_goal"]).item()
            print(f"episode {episode}: success {end['success'].item()}, {left:.3f} m")


if __name__ == "__main__":
    main(tyro.cli(Args))
