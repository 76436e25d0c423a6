"""Plan instead of learning: torchrl's cross-entropy method, with Bullet as its model.

python examples/plan.py --episodes 3

Every plan forks the exact state of one environment over many, tries a sequence of
actions in each, and looks for better ones near the best. The first action is taken.
"""

from dataclasses import dataclass
from typing import Annotated, Any

import torch
import tyro
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.modules import CEMPlanner

import torch_panda
from torch_panda.learning.limits import Limit, Positive, Seed, check_limits

ACTION_SCALE = 0.02  # [m] by which an action of 1 moves the hand, to try out
BEHIND = 0.04  # [m] from its middle, where the hand pushes a cube
NEAR = 0.1  # [m] from its goal, where the hand need not stay at the cube
APPROACH = 0.5  # weight of the hand's distance from there, beside the cube's distance


@dataclass
class Args:
    """What to solve, and how hard to think."""

    env_id: str = "PandaPush-v1"
    """one of torch_panda.ENV_IDS whose goal is a position, such as Push"""
    episodes: Positive = 5
    """episodes to run"""
    seed: Seed = 0
    """of the episodes and of the plans"""
    num_candidates: Annotated[int, Limit("at least 12", lambda x: x >= 12)] = 32
    """action sequences that are tried at once, each in an environment"""
    optim_steps: Positive = 3
    """how often they are drawn for a plan, around the best sixth"""
    planning_horizon: Positive = 4
    """actions in a sequence"""
    hold: Positive = 4
    """steps for which each action is taken"""


def make(args: Args, **options: Any) -> torch_panda.RobotTaskEnv:  # noqa: ANN401
    """Environments of the id, with small actions."""
    options["robot_options"] = {"action_scale": ACTION_SCALE}
    return torch_panda.make(args.env_id, **options)


class Fork(EnvBase):
    """A planner's model: rollouts that go on from ``state`` where ``index`` is 0."""

    def __new__(cls, *args: Any, **kwargs: Any) -> "Fork":  # noqa: ANN401, D102
        return super().__new__(cls, *args, _batch_locked=False, **kwargs)

    def __init__(self, args: Args) -> None:
        super().__init__(batch_size=())
        self.hold = args.hold
        self.model = make(args, num_envs=args.num_candidates)
        self.action_spec = Bounded(-1.0, 1.0, self.model.action_spec.shape[-1:])
        self.observation_spec = Composite(index=Unbounded(1, dtype=torch.int64))
        self.reward_spec = Unbounded(1)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        if not tensordict["index"].any():
            state = tensordict.get("state")
            self.now = self.model.reset(state, set_state=True)
        reward = torch.zeros(*tensordict.batch_size, 1)
        for _ in range(self.hold):
            self.now["action"] = tensordict["action"]
            self.now = self.model.step(self.now)["next"]  # type: ignore[assignment]
            goal, achieved = self.now["desired_goal"], self.now["achieved_goal"]
            behind = achieved - BEHIND * torch.nn.functional.normalize(goal - achieved)
            far = (behind - self.now["observation"][:, :3]).norm(dim=1, keepdim=True)
            left = self.model.task.distance(achieved, goal)
            reward -= left + APPROACH * far * (left / NEAR).clamp(max=1.0)
        td = {"index": tensordict["index"] + 1, "reward": reward, "done": reward > 0}
        return TensorDict(td, reward.shape[:1])  # never done: rewards are negative

    def _reset(
        self, tensordict: TensorDictBase | None = None, **kwargs: object
    ) -> TensorDict:
        raise NotImplementedError("a fork starts from a state")

    def _set_seed(self, seed: int | None) -> None:
        """Nothing is drawn here."""


def solve(env: torch_panda.RobotTaskEnv, fork: Fork, args: Args) -> TensorDictBase:
    """Plan and act for an episode of one environment; return its last step."""
    sizes = args.planning_horizon, args.optim_steps, args.num_candidates
    planner = CEMPlanner(fork, *sizes, top_k=args.num_candidates // 6)
    td = env.reset()
    while not td["done"]:
        start = {"state": env.get_state(exact=True), "index": torch.tensor([0])}
        action = planner(TensorDict(start))["action"]
        for _ in range(args.hold):
            if not td["done"]:
                td = env.step(td.set("action", action))["next"]  # type: ignore[assignment]
    return td


def main(args: Args) -> None:
    """Run the episodes and print how they end."""
    try:
        check_limits(args)
        env = make(args, seed=args.seed)
        if env.task.goal_dim != 3:
            raise ValueError(f"the goal must be a position, {args.env_id}'s is not")
        fork = Fork(args)
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
