"""Refining a policy by imitating what it achieves."""

import json

import pytest
import torch
from tensordict import TensorDict

import refine
import torch_panda
from evaluate import evaluate
from training.policies import load_agent, load_policy, read_checkpoint, save_policy

pytestmark = pytest.mark.usefixtures("quick")
POLICIES = refine.Path(refine.__file__).parent / "policies"


def episode(achieved: list[float], asked: list[float]) -> TensorDict:
    goals = torch.tensor(asked).expand(2, -1)
    following = {
        "achieved_goal": torch.stack(
            (torch.zeros(len(achieved)), torch.tensor(achieved))
        ),
        "desired_goal": goals,
    }
    return TensorDict({"desired_goal": goals, "next": following}, [2])


def test_the_goal_becomes_what_was_achieved_where_goals_differ():
    varies = torch.tensor([True, True, False])
    slid = episode([0.5, 0.1, 0.015], [0.4, 0.3, 0.03])
    slid = refine.ask_for_achieved(slid, torch_panda.Slide(), varies)
    expected = torch.tensor([[0.5, 0.1, 0.03]] * 2)
    torch.testing.assert_close(slid["desired_goal"], expected)
    torch.testing.assert_close(slid["next", "desired_goal"], expected)


def test_an_episode_that_achieves_what_is_never_asked_for_is_left_out():
    fallen = episode([0.5, 0.1, -0.3], [0.1, 0.1, 0.02])  # off the table
    varies = torch.tensor([True, True, False])
    assert refine.ask_for_achieved(fallen, torch_panda.Push(), varies) is None


@pytest.fixture
def crooked(tmp_path):
    """A policy of Reach whose hand comes to rest beside the goal."""
    saved = read_checkpoint(POLICIES / "PandaReach-v1.pt")
    with torch_panda.make("PandaReach-v1", num_envs=2) as env:
        agent = load_agent(saved, env)
    with torch.no_grad():
        agent.actor[0][-1].bias[0] += 1.5
    save_policy(tmp_path / "crooked.pt", agent, "PandaReach-v1")
    return tmp_path / "crooked.pt"


def success(path: refine.Path) -> float:
    with torch_panda.make("PandaReach-v1", num_envs=32, seed=5) as env:
        policy = load_policy(read_checkpoint(path), env)
        return float(evaluate(env, policy, 64).success.float().mean())


def test_a_policy_that_misses_learns_to_hit(crooked, tmp_path):
    assert success(crooked) < 0.2
    out = tmp_path / "run"
    refine.main(refine.Args(crooked, out, steps=12_800, updates=800, batch_size=512))
    assert success(out) > 0.9
    assert json.loads((out / "args.json").read_text())["preset"] == "refined"


class Stop:
    """True from the n-th time on that it is asked."""

    def __init__(self, n: int) -> None:
        self.left = n

    def __bool__(self) -> bool:
        self.left -= 1
        return self.left <= 0


@pytest.mark.parametrize("asked", [2, 8])  # while it plays, and while it imitates
def test_a_stopped_run_goes_on_bit_for_bit(crooked, tmp_path, asked):
    policies = []
    for name, stops in (("whole", [False]), ("stopped", [Stop(asked), False])):
        for stop in stops:
            options = {"steps": 400, "updates": 6, "num_envs": 4, "batch_size": 64}
            args = refine.Args(crooked, tmp_path / name, **options)
            args.resume = stop is not stops[0]
            run = refine.Refinement(args)
            args.out.mkdir(exist_ok=True)
            assert run.run(stop) == (not isinstance(stop, Stop))
            run.close()
        policies.append(run.agent.state_dict())
        assert len(run.progress.curve) == 2
    for key, value in policies[0].items():
        assert torch.equal(value, policies[1][key]), key


def test_what_cannot_be_refined_is_refused(crooked, tmp_path):
    with pytest.raises(SystemExit, match="there is no file"):
        refine.main(refine.Args(tmp_path / "missing.pt", tmp_path / "run"))
    with pytest.raises(SystemExit, match="updates must be positive"):
        refine.main(refine.Args(crooked, tmp_path / "run", updates=0))
    with pytest.raises(SystemExit, match="trained on PandaReach-v1"):
        refine.main(refine.Args(crooked, tmp_path / "run", env_id="PandaPush-v1"))
