"""Learning from a file of demonstrations, before and beside one's own transitions."""

import re
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

import torch_panda
from tests.commands.runs import After, Kill, weights
from torch_panda.commands.train import make_run
from torch_panda.datasets.demonstrations import read_demos
from torch_panda.learning import training
from torch_panda.learning.options import Args

pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture
def env():
    with torch_panda.make("PandaPush-v1", num_envs=1) as env:
        yield env


def test_demonstrations_keep_their_goals(env, make_demos, tmp_path):
    path = make_demos()
    demos = read_demos(str(path), env)
    run = make_run(small(path), tmp_path)
    batch = run.source.demos.sample(500)
    run.close()
    goal = demos["desired_goal"].unflatten(0, (4, 50))[:, 0]
    assert (batch["desired_goal"] == goal[batch["collector", "traj_ids"]]).all()
    assert len(batch["index"].unique()) > 100


@pytest.mark.parametrize("case", ["time first", "pieces", "one id", "without ends"])
def test_episodes_are_found_in_any_layout(env, make_demos, case):
    path = make_demos()
    whole = TensorDict(torch.load(path)).auto_batch_size_(1).unflatten(0, (4, 50))
    content = whole.clone()
    if case == "time first":
        content = content.transpose(0, 1)
    elif case == "pieces":  # as a collector yields them
        content = torch.cat([content[:, :20].reshape(-1), content[:, 20:].reshape(-1)])
    else:
        content["collector", "traj_ids"].fill_(7)
        content["next", "done"] &= case == "one id"
    torch.save(content.to_dict(), path)
    demos = read_demos(path, env).unflatten(0, (4, 50))
    assert (demos["observation"] == whole["observation"]).all()
    assert (demos["collector", "traj_ids"] == torch.arange(4)[:, None]).all()


def test_actions_beyond_the_limits_are_clipped(env, make_demos):
    path = make_demos()
    content = TensorDict(torch.load(path))
    content["action"] *= 3
    # Demonstrations of double precision become float32.
    torch.save(content.to(torch.float64).to_dict(), path)
    demos = read_demos(path, env)
    action = demos["action"]
    assert torch.equal(action, content["action"].clamp(-1, 1))
    assert action.max() == 1
    assert demos["observation"].dtype == action.dtype == torch.float32


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda x: x.exclude("desired_goal"), "there is no entry 'desired_goal'"),
        (
            lambda x: x.set("observation", x["observation"][:, :6]),
            "its observation has size 6, that of the environment has size 18",
        ),
        (
            lambda x: x.auto_batch_size_(1)[torch.randperm(200)],
            "not in the order of time",
        ),
        (lambda x: x.exclude(("next", "reward")), r"no entry \('next', 'reward'\)"),
        (lambda x: x.set("action", x["action"][:-1]), "does not hold demonstrations"),
        (lambda x: x.auto_batch_size_(1)[:0], "holds no transitions"),
        (
            lambda x: x.set(("next", "reward"), x["next", "reward"].squeeze(-1)),
            r"shape \[\.\.\., 1\].*got \(200,\) for 200",
        ),
    ],
)
def test_wrong_demonstrations_are_refused(env, make_demos, spoil, message):
    path = make_demos()
    torch.save(spoil(TensorDict(torch.load(path))).to_dict(), path)
    with pytest.raises(ValueError, match=f"^{re.escape(str(path))}.*{message}"):
        read_demos(path, env)


def test_demonstrations_of_other_rewards_are_refused(make_demos):
    path = make_demos()
    with (
        torch_panda.make("PandaPushDense-v1", num_envs=1) as env,
        pytest.raises(ValueError, match=r"100% of the rewards .* is -1 instead of -0"),
    ):
        read_demos(path, env)


def test_an_environment_without_observations_is_refused(make_demos):
    options = {"from_pixels": True, "pixels_only": True, "render_size": 8}
    with (
        torch_panda.make("PandaPush-v1", num_envs=1, **options) as env,
        pytest.raises(ValueError, match="make it without pixels_only"),
    ):
        read_demos(make_demos(), env)


def test_rewards_that_are_no_function_of_goals_are_accepted(make_demos):
    class Effort(torch_panda.Push):
        def reward(self, simulation, action, achieved_goal, desired_goal):
            return -action.square().sum(1, keepdim=True)

    path = make_demos()
    content = torch.load(path)
    content["next"]["reward"] = -content["action"].square().sum(1, keepdim=True)
    torch.save(content, path)
    robot = torch_panda.Panda(block_gripper=True)
    with torch_panda.RobotTaskEnv(robot=robot, task=Effort()) as env:
        demos = read_demos(path, env)
    assert torch.equal(demos["next", "reward"], content["next"]["reward"])


def small(path, **options):
    return Args(env_id="PandaPush-v1", demos=path, num_envs=2, **options)


def test_a_ratio_of_each_batch_is_demonstrations(make_demos, tmp_path):
    options = {"total_steps": 100, "updates_per_step": 0.05, "batch_size": 32}
    run = make_run(small(make_demos(), **options), tmp_path)
    sizes, update = [], run.agent.update
    run.agent.update = lambda batch, demos: (
        sizes.append((len(batch), len(demos))) or update(batch, demos)
    )
    assert run.train()
    run.close()
    assert sizes == [(24, 8)] * 5
    assert run.agent.normalizer.count == 200 + 100
    assert len(run.source) == 100


def test_imitation_saves_at_intervals_and_at_its_end(make_demos, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "SAVE_INTERVAL", 12)
    args = small(make_demos(), total_steps=0, pretrain_updates=40)
    run = make_run(args, tmp_path)
    saved = []
    run.checkpoint.save = lambda: saved.append(run.progress.pretrained)
    assert run.train()
    run.close()
    assert sorted(set(saved)) == [0, 12, 24, 36, 40]


def test_imitation_goes_on_where_it_was_stopped(make_demos, tmp_path):
    options = {"total_steps": 0, "pretrain_updates": 20, "augmentation": "mirror"}
    args = small(make_demos(), algo="td3", **options)

    whole = make_run(args, tmp_path / "whole")
    before = weights(whole)
    assert whole.train()
    after = weights(whole)
    whole.close()
    changed = {key for key in after if not torch.equal(before[key], after[key])}
    assert changed
    assert any("target_actor" in key for key in changed)
    assert not any("value" in key or "critic" in key for key in changed)
    assert not any("normalizer" in key for key in changed)
    assert [row["step"] for row in whole.progress.curve] == [0, 0]

    stopped = make_run(args, tmp_path)
    assert not stopped.train(After(6))
    stopped.close()
    assert len(stopped.progress.curve) == 1
    kept = torch.load(tmp_path / "checkpoint.pt")["policy"]
    parts = {x: part.state_dict() for x, part in stopped.agent.policy_parts.items()}
    torch.testing.assert_close(kept, parts, rtol=0, atol=0)
    args.resume = True
    resumed = make_run(args, tmp_path)
    assert resumed.progress.pretrained == 7
    assert resumed.train()
    resumed.close()
    torch.testing.assert_close(weights(resumed), after, rtol=0, atol=0)
    points = [run.progress.curve[-1]["success"] for run in (resumed, whole)]
    assert points[0] == points[1]


def test_a_run_is_not_resumed_with_other_demonstrations(make_demos, tmp_path):
    args = small(make_demos(), total_steps=0, pretrain_updates=1)
    run = make_run(args, tmp_path)
    run.checkpoint.save()
    run.close()
    make_run(replace(args, resume=True), tmp_path).close()
    content = torch.load(args.demos)
    content["action"] *= 0.5
    torch.save(content, args.demos)
    with pytest.raises(ValueError, match="cannot resume with other data"):
        make_run(replace(args, resume=True), tmp_path)


def test_the_imitation_is_evaluated_also_after_a_kill(make_demos, tmp_path):
    """A kill, or a second Ctrl-C, ends the evaluation after the last imitation."""
    options = {"total_steps": 100, "pretrain_updates": 4, "updates_per_step": 0.05}
    args = small(make_demos(), **options)
    whole = make_run(args, tmp_path / "whole")
    assert whole.train()
    whole.close()

    killed = make_run(args, tmp_path)
    add = killed.curve.add

    def add_or_die(progress, losses=None):
        if progress.curve:
            raise Kill
        add(progress, losses)

    killed.curve.add = add_or_die
    with pytest.raises(Kill):
        killed.train()
    killed.close()
    resumed = make_run(replace(args, resume=True), tmp_path)
    assert resumed.train()
    resumed.close()
    assert [row["step"] for row in resumed.progress.curve] == [0, 0, 100]
    state = resumed.agent.state_dict()
    for key, value in whole.agent.state_dict().items():
        assert torch.equal(state[key], value), key
