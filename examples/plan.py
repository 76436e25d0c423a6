"""Planning instead of learning: torchrl's CEMPlanner with Bullet as its model.

    python examples/plan.py

Each plan copies the exact state of one environment into many others, tries a sequence
of actions in each, and samples better sequences near the best ones. The environment
then takes the first action. No training is needed.
"""

import torch
from tensordict import TensorDict, TensorDictBase
from torch.nn.functional import normalize
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.modules import CEMPlanner

import torch_panda

ENV_ID = "PandaPush-v1"  # the goal must be a position
EPISODES = 5
NUM_CANDIDATES = 32  # action sequences tried at once, each in an environment
OPTIM_STEPS = 3  # rounds of sampling per plan, around the best sixth
HORIZON = 4  # actions in a sequence
HOLD = 4  # environment steps per action
ACTION_SCALE = 0.02  # displacement of the hand by an action of 1 [m]
BEHIND = 0.04  # distance from the cube's centre at which the hand pushes it [m]
NEAR = 0.1  # distance from the goal below which the hand may leave the cube [m]
APPROACH = 0.5  # weight of the hand's distance relative to the cube's


def make_env(num_envs: int | None = None) -> torch_panda.RobotTaskEnv:
    """Environments with small actions."""
    options: dict = {"action_scale": ACTION_SCALE}
    return torch_panda.make(ENV_ID, num_envs=num_envs, seed=0, robot_options=options)


class Fork(EnvBase):
    """The model of a planner: rollouts that continue from the entry ``state``.

    CEMPlanner rolls out a batch of any size from one start, so `Fork` sets the state
    of its environments in the first step of a rollout, where ``index`` is 0.
    """

    def __new__(cls) -> "Fork":
        """Accept TensorDicts of any batch size."""
        return super().__new__(cls, _batch_locked=False)

    def __init__(self) -> None:
        super().__init__(batch_size=())
        self.model = make_env(NUM_CANDIDATES)
        self.action_spec = Bounded(-1.0, 1.0, self.model.action_spec.shape[-1:])
        self.observation_spec = Composite(index=Unbounded(1, dtype=torch.int64))
        self.reward_spec = Unbounded(1)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        if not tensordict["index"].any():
            self.now = self.model.reset(tensordict.get("state"), set_state=True)
        reward = torch.zeros(*tensordict.batch_size, 1)
        for _ in range(HOLD):
            self.now["action"] = tensordict["action"]
            self.now = self.model.step(self.now)["next"]  # type: ignore[assignment]
            goal, cube = self.now["desired_goal"], self.now["achieved_goal"]
            distance = self.model.task.distance(cube, goal)
            hand_goal = cube - BEHIND * normalize(goal - cube)
            hand_error = (hand_goal - self.now["observation"][:, :3]).norm(dim=1)
            weight = APPROACH * (distance / NEAR).clamp(max=1.0)
            reward -= distance + weight * hand_error[:, None]
        done = torch.zeros_like(reward, dtype=torch.bool)
        result = {"index": tensordict["index"] + 1, "reward": reward, "done": done}
        return TensorDict(result, tensordict.batch_size)

    def _reset(self, tensordict: TensorDictBase) -> TensorDict:  # type: ignore[override]
        raise NotImplementedError("a Fork starts from the state in its input")

    def _set_seed(self, seed: int | None) -> None:
        """Nothing is random here."""


def solve(env: torch_panda.RobotTaskEnv, fork: Fork) -> TensorDictBase:
    """Plan and act until an episode ends; return its last step."""
    sizes = HORIZON, OPTIM_STEPS, NUM_CANDIDATES
    planner = CEMPlanner(fork, *sizes, top_k=NUM_CANDIDATES // 6)
    td = env.reset()
    while not td["done"]:
        start = {"state": env.get_state(exact=True), "index": torch.tensor([0])}
        action = planner(TensorDict(start))["action"]
        for _ in range(HOLD):
            if not td["done"]:
                td = env.step(td.set("action", action))["next"]  # type: ignore[assignment]
    return td


if __name__ == "__main__":
    torch.manual_seed(0)
    env, fork = make_env(), Fork()
    with torch.no_grad():
        for episode in range(EPISODES):
            end = solve(env, fork)
            print(f"episode {episode}: success {end['success'].item()}")
