"""The planner: forks go on as the environment does, and plans lead somewhere."""

import plan
import pytest
import torch
from plan import Args
from tensordict import TensorDict


@pytest.fixture
def args():
    return Args(
        env_id="PandaPush-v1",
        num_candidates=12,
        optim_steps=2,
        planning_horizon=2,
        hold=3,
    )


def test_forks_go_on_as_the_environment_does(args):
    torch.manual_seed(0)
    with plan.make(args, seed=0) as env:
        fork = plan.Fork(args)
        td = env.reset()
        for _ in range(8):  # down onto the cube, and over the table
            towards = (td["achieved_goal"] - td["observation"][:3]) * 20
            td = env.step(td.set("action", towards))["next"]
        start = TensorDict(
            {"state": env.get_state(exact=True), "index": torch.tensor([0])}
        )
        actions = torch.rand(args.num_candidates, 2, 3) * 2 - 1
        actions[3] = actions[1]
        found = start.expand(args.num_candidates).to_tensordict()
        for step in range(2):
            found["action"] = actions[:, step]
            found = fork.step(found)["next"].set("state", found["state"])
            for _ in range(args.hold):
                td = env.step(td.set("action", actions[1, step]))["next"]
        seen = fork.now["observation"]
        assert torch.equal(seen[1], td["observation"])
        assert torch.equal(seen[3], td["observation"])
        assert len(seen.unique(dim=0)) == args.num_candidates - 1
        fork.model.close()


def test_plans_lead_to_the_goal(args):
    torch.manual_seed(0)
    args.env_id = "PandaReach-v1"
    with plan.make(args, seed=0, max_episode_steps=18) as env:
        fork = plan.Fork(args)
        start = env.reset()
        before = env.task.distance(start["achieved_goal"], start["desired_goal"])
        env.set_seed(0)  # the same episode
        with torch.no_grad():
            end = plan.solve(env, fork, args)
        assert torch.equal(end["desired_goal"], start["desired_goal"])
        after = env.task.distance(end["achieved_goal"], end["desired_goal"])
        assert after < 0.6 * before
        fork.model.close()


def test_a_goal_that_is_no_position_is_refused(args):
    args.env_id = "PandaStack-v1"
    with pytest.raises(SystemExit, match=r"position.*PandaStack-v1"):
        plan.main(args)
