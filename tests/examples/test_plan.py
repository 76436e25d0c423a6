"""The planner: forks continue as the environment does, and plans approach the goal."""

import plan
import pytest
import torch
from tensordict import TensorDict

import torch_panda


@pytest.fixture
def small(monkeypatch):
    """Small plans, and the same random draws in every run."""
    torch.manual_seed(0)
    sizes = {"NUM_CANDIDATES": 12, "OPTIM_STEPS": 2, "HORIZON": 2, "HOLD": 3}
    for name, value in sizes.items():
        monkeypatch.setattr(plan, name, value)


def test_forks_continue_as_the_environment_does(small):
    with plan.make_env() as env:
        fork = plan.Fork()
        td = env.reset()
        for _ in range(8):  # down onto the cube, and over the table
            towards = (td["achieved_goal"] - td["observation"][:3]) * 20
            td = env.step(td.set("action", towards))["next"]
        start = TensorDict(
            {"state": env.get_state(exact=True), "index": torch.tensor([0])}
        )
        actions = torch.rand(plan.NUM_CANDIDATES, 2, 3) * 2 - 1
        actions[3] = actions[1]
        forked = start.expand(plan.NUM_CANDIDATES).to_tensordict()
        for step in range(2):
            forked["action"] = actions[:, step]
            forked = fork.step(forked)["next"].set("state", forked["state"])
            for _ in range(plan.HOLD):
                td = env.step(td.set("action", actions[1, step]))["next"]
        observation = fork.now["observation"]
        assert torch.equal(observation[1], td["observation"])
        assert torch.equal(observation[3], td["observation"])
        assert len(observation.unique(dim=0)) == plan.NUM_CANDIDATES - 1
        fork.model.close()


def test_plans_approach_the_goal(small, monkeypatch):
    options = {"robot_options": {"action_scale": plan.ACTION_SCALE}}
    monkeypatch.setattr(
        plan,
        "make_env",
        lambda num_envs=None: torch_panda.make(
            "PandaReach-v1", num_envs=num_envs, seed=0, max_episode_steps=21, **options
        ),
    )
    with plan.make_env() as env:
        fork = plan.Fork()
        start = env.reset()
        before = env.task.distance(start["achieved_goal"], start["desired_goal"])
        env.set_seed(0)  # the same episode
        with torch.no_grad():
            end = plan.solve(env, fork)
        assert torch.equal(end["desired_goal"], start["desired_goal"])
        after = env.task.distance(end["achieved_goal"], end["desired_goal"])
        assert after < 0.6 * before
        fork.model.close()
