"""Refining a policy by imitating what it achieves."""

import json

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

import torch_panda
from tests.commands.runs import After
from torch_panda.commands import refine
from torch_panda.learning.agents import Hyperparameters, make_agent
from torch_panda.learning.files.policy_files import SavedPolicy, save_policy
from torch_panda.policies import shipped_policies

pytestmark = pytest.mark.usefixtures("quick")


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
    slid = refine.relabel(slid, torch_panda.Slide(), varies)
    expected = torch.tensor([[0.5, 0.1, 0.03]] * 2)
    torch.testing.assert_close(slid["desired_goal"], expected)
    torch.testing.assert_close(slid["next", "desired_goal"], expected)


def test_an_episode_that_achieves_what_is_never_asked_for_is_left_out():
    fallen = episode([0.5, 0.1, -0.3], [0.1, 0.1, 0.02])  # off the table
    varies = torch.tensor([True, True, False])
    assert refine.relabel(fallen, torch_panda.Push(), varies) is None


@pytest.fixture
def crooked(tmp_path):
    """A policy of Reach whose hand comes to rest beside the goal."""
    agent = SavedPolicy.read(shipped_policies()["PandaReach-v1"]).make_agent()
    with torch.no_grad():
        agent.actor[0][-1].bias[0] += 2.0
    save_policy(tmp_path / "crooked.pt", agent, "PandaReach-v1")
    return tmp_path / "crooked.pt"


def success(path: refine.Path) -> float:
    policy = torch_panda.load_policy(path)
    options = {"episodes": 24, "num_envs": 6, "seed": 5}
    return torch_panda.evaluate(policy, "PandaReach-v1", **options).success_rate


@pytest.mark.slow
def test_a_policy_that_misses_learns_to_hit(crooked, tmp_path):
    assert success(crooked) < 0.2
    out = tmp_path / "run"
    changed = {"steps": 6_400, "updates": 600, "batch_size": 256, "num_envs": 8}
    refine.main(refine.Args(crooked, out, **changed))
    assert success(out) > 0.9
    options = json.loads((out / "args.json").read_text())
    assert options["preset"] == "refined"
    assert options["changed"] == changed


@pytest.mark.slow
@pytest.mark.parametrize("asked", [1, 7])  # while it plays, and while it imitates
def test_a_stopped_refinement_goes_on_bit_for_bit(crooked, tmp_path, asked):
    policies = []
    for name, stops in (("whole", [False]), ("stopped", [After(asked), False])):
        for stop in stops:
            options = {"steps": 200, "updates": 6, "num_envs": 2, "batch_size": 64}
            args = refine.Args(crooked, tmp_path / name, **options)
            args.resume = stop is not stops[0]
            run = refine.Refinement(args)
            args.out.mkdir(exist_ok=True)
            assert run.run(stop) == (stop is False)
            run.close()
        policies.append(run.agent.state_dict())
        assert len(run.progress.curve) == 2
    for key, value in policies[0].items():
        assert torch.equal(value, policies[1][key]), key


def test_a_stochastic_policy_is_refined_without_its_noise(tmp_path, monkeypatch):
    with torch_panda.make("PandaReach-v1", num_envs=2) as env:
        agent = make_agent(env, Hyperparameters(algo="sac"))
    save_policy(tmp_path / "sac.pt", agent, "PandaReach-v1")
    options = {"steps": 100, "updates": 1, "num_envs": 2, "batch_size": 4}
    run = refine.Refinement(refine.Args(tmp_path / "sac.pt", tmp_path, **options))
    asked = []
    monkeypatch.setattr(refine, "relabel", lambda x, *_: asked.append(x))
    run.play(stop=False)
    run.close()
    assert len(asked) == 2
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        for episode in asked:
            played = episode["action"].clone()
            own = run.agent.policy(episode.clone())["action"]
            torch.testing.assert_close(played, own)


def test_a_task_with_other_spaces_is_refused(crooked, tmp_path):
    other = {"env_id": "PandaPush-v1", "num_envs": 1}
    with pytest.raises(SystemExit, match="trained on PandaReach-v1"):
        refine.main(refine.Args(crooked, tmp_path / "run", **other))
