"""A torchrl environment of a user, trained in from Python."""

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from tests.commands.runs import read_curve
from torch_panda.learning.options import Args
from torch_panda.learning.recipes import RECIPE, find_options
from torch_panda.learning.training import Run

STEPS = 20


class Point(EnvBase):
    """A point that actions move by at most 4 cm towards a goal in three dimensions."""

    max_episode_steps = STEPS
    terminate_on_success = False

    def __init__(self, num_envs: int) -> None:
        super().__init__(batch_size=torch.Size([num_envs]))

        def numbers(size: int) -> Unbounded:
            return Unbounded(torch.Size([num_envs, size]))

        def flag() -> Binary:
            return Binary(shape=torch.Size([num_envs, 1]), dtype=torch.bool)

        self.observation_spec = Composite(
            observation=numbers(3),
            achieved_goal=numbers(3),
            desired_goal=numbers(3),
            success=flag(),
            shape=self.batch_size,
        )
        self.action_spec = Bounded(-1, 1, torch.Size([num_envs, 3]))
        self.reward_spec = numbers(1)
        ends = {key: flag() for key in ("done", "terminated", "truncated")}
        self.done_spec = Composite(ends, shape=self.batch_size)
        self.position = torch.zeros(num_envs, 3)
        self.goal = torch.zeros(num_envs, 3)
        self.step_count = torch.zeros(num_envs, 1)

    def compute_reward(self, achieved_goal, desired_goal):
        distance = (achieved_goal - desired_goal).norm(dim=-1, keepdim=True)
        return -(distance > 0.05).float()

    def _observe(self) -> TensorDict:
        is_over = self.step_count >= STEPS
        observed = {
            "observation": self.position.clone(),
            "achieved_goal": self.position.clone(),
            "desired_goal": self.goal.clone(),
            "success": self.compute_reward(self.position, self.goal) == 0,
            "done": is_over,
            "truncated": is_over.clone(),
            "terminated": torch.zeros_like(is_over),
        }
        return TensorDict(observed, self.batch_size)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object):
        chosen = torch.ones(self.batch_size, dtype=torch.bool)
        if tensordict is not None:
            chosen = tensordict.get("_reset", chosen).view(-1)
        self.position[chosen] = self.step_count[chosen] = 0
        self.goal[chosen] = torch.rand(int(chosen.sum()), 3) - 0.5
        return self._observe()

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self.position = self.position + 0.04 * tensordict["action"]
        self.step_count = self.step_count + 1
        reward = self.compute_reward(self.position, self.goal)
        return self._observe().set("reward", reward)

    def _set_seed(self, seed: int | None) -> None:
        pass  # torch's global generator draws the goals


def test_a_torchrl_environment_of_ones_own_is_trained_from_python(tmp_path):
    options = find_options(Point(4))
    assert options == {"gamma": 1 - 1 / (0.4 * STEPS)}
    options |= {"total_steps": 320, "eval_interval": 160, "updates_per_step": 0.25}
    options = RECIPE | options
    made, out = [], tmp_path / "new" / "run"
    run = Run(
        Args(env_id="Point", preset="recipe", **options),
        out,
        make_own_env=lambda n: made.append(n) or Point(n),
    )
    assert run.train()
    run.close()
    with pytest.raises(ValueError, match="holds a run"):
        Run(run.args, out, make_own_env=Point)
    assert made == [8, 16]  # for the episodes of the training and of the evaluations
    assert [row["step"] for row in read_curve(out)] == ["0", "160", "320"]
    assert run.agent.updates == 80
    spaces = run.agent.spaces
    assert spaces.geometry.positions == (0,)  # the hand
    assert spaces.geometry.points == (3, 4, 5)  # the goal, relative to the hand
    assert spaces.action_scale == pytest.approx(0.04, rel=1e-3)
