"""A training writes its files, stops and resumes."""

import json
import os
import signal
from dataclasses import fields, replace

import imageio.v3 as iio
import pytest
import torch
from tensordict import TensorDict

import torch_panda
from tests.commands.runs import After, Kill, points, read_curve, weights
from tests.devices import DEVICES
from torch_panda.commands import evaluate, plot, train
from torch_panda.commands.train import parse
from torch_panda.learning import training
from torch_panda.learning.environments import starts
from torch_panda.learning.evaluation import curve, evaluate_episodes
from torch_panda.learning.options import Args, check, default_args
from torch_panda.learning.training import Run

pytestmark = pytest.mark.usefixtures("quick")


def test_a_training_writes_files_that_other_commands_read(tmp_path, capsys):
    out = tmp_path / "run"
    train.main(Args(total_steps=200, eval_interval=200, out=out, noise_eps=0.1))
    assert "after 200 steps; see" in capsys.readouterr().out
    rows = read_curve(out)
    assert [row["step"] for row in rows] == ["0", "200"]
    assert all(0 <= float(row["success"]) <= 1 for row in rows)
    assert [row["updates"] for row in rows] == ["0", "100"]
    assert rows[0]["critic_loss"] == ""
    assert float(rows[-1]["critic_loss"]) > 0
    assert json.loads((out / "args.json").read_text())["changed"] == {"noise_eps": 0.1}
    assert (out / "curve.png").read_bytes().startswith(b"\x89PNG")
    assert len(iio.imread(out / "video.mp4")) == 51
    content = torch.load(out / "checkpoint.pt", weights_only=True)
    assert content["env_id"] == "PandaReach-v1"
    assert content["policy"].keys() == {"normalizer", "actor"}
    for part in content["policy"].values():
        assert all(value.isfinite().all() for value in part.values())
    assert content["policy"]["normalizer"]["count"] == 200
    assert (out / "checkpoint.pt").stat().st_size < 2 * 2**20

    evaluate.main(evaluate.Args(run=out, episodes=2))
    assert "PandaReach-v1, 2 episodes" in capsys.readouterr().out
    plot.main(plot.Args(runs=[tmp_path], out=tmp_path / "all.png"))
    assert (tmp_path / "all.png").read_bytes().startswith(b"\x89PNG")


def test_the_curve_is_that_of_the_saved_policy(tmp_path):
    """The saved policy has averaged weights, which differ from those that explore."""
    args = Args(env_id="PandaReachDense-v1", num_envs=1, total_steps=50, ema_rate=0.1)
    run = Run(args, tmp_path)
    with torch.no_grad():
        run.agent.actor[0][-1].bias += 2.0
    torch.manual_seed(0)
    run.curve.add(run.progress)
    run.close()
    torch.manual_seed(0)
    with torch_panda.make(args.env_id, num_envs=curve.NUM_ENVS) as env:
        curve.reseed(env)
        policy = torch_panda.load_policy(tmp_path)
        result = evaluate_episodes(env, policy, curve.EPISODES)
    expected = pytest.approx(result.mean_return, rel=1e-5)
    assert run.progress.curve[0]["return"] == expected


# Kinds of state: SAC's temperature; state of exploration, averaged weights, delayed
# targets, reached states and a falling learning rate. Other algorithms have no state of
# another kind.
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    "options",
    [
        {"algo": "sac", "desired_ratio": 0.5},
        {
            **{"keep_unmoved": 0.1, "relative_inputs": "fine"},
            **{"augmentation": "mirror-shift", "start_at_reached": 0.5},
            **{"exploration": "points", "ema_rate": 0.1},
        },
    ],
    ids=["sac", "recipe"],
)
def test_a_resumed_run_equals_an_uninterrupted_run_bit_for_bit(
    tmp_path, options, device, monkeypatch
):
    monkeypatch.setattr(starts, "FEWEST", 10)
    args = Args(env_id="PandaPush-v1", num_envs=2, total_steps=200, **options)
    args = replace(args, updates_per_step=0.1, eval_interval=100, device=device)
    whole = Run(args, tmp_path)
    assert whole.train()
    whole.close()
    assert whole.agent.updates == 20
    assert [row["step"] for row in whole.progress.curve] == [0, 100, 200]

    (tmp_path / "stopped").mkdir()
    stopped = Run(args, tmp_path / "stopped")
    assert not stopped.train(After(0))
    stopped.close()
    assert stopped.progress.steps == 100
    resumed = Run(replace(args, resume=True), tmp_path / "stopped")
    assert resumed.progress.steps == 100
    assert resumed.train()
    resumed.close()
    torch.testing.assert_close(weights(resumed), weights(whole), rtol=0, atol=0)
    assert points(resumed) == points(whole)
    length = len(whole.source.buffer)
    if args.keep_unmoved == 1:  # each of two iterations has two new episodes
        assert (
            len(whole.source.buffer.storage[:length]["desired_goal"].unique(dim=0)) == 4
        )
    assert len(resumed.source.buffer) == length
    for key in ("observation", "desired_goal", "action", ("next", "reward")):
        ours = resumed.source.buffer.storage[:length][key]
        assert torch.equal(ours, whole.source.buffer.storage[:length][key])


def test_a_finished_run_continues_with_more_steps(tmp_path):
    """The result is that of a run that had all steps from the start."""
    args = Args(env_id="PandaPush-v1", num_envs=1, total_steps=50, video=False)
    args = replace(args, updates_per_step=0.1, eval_interval=50)
    whole = Run(replace(args, total_steps=100), tmp_path)
    whole.train()
    whole.close()

    args.out = tmp_path / "continued"
    train.main(args)
    train.main(replace(args, resume=True, total_steps=100))
    written = json.loads((args.out / "args.json").read_text())
    assert written["total_steps"] == 100
    continued = Run(replace(args, resume=True, total_steps=100), args.out)
    continued.close()
    torch.testing.assert_close(weights(continued), weights(whole), rtol=0, atol=0)
    assert points(continued) == points(whole)
    assert len(continued.source.buffer) == len(whole.source.buffer)
    for ours, theirs in zip(
        continued.source.buffer[:], whole.source.buffer[:], strict=True
    ):
        assert torch.equal(ours["observation"], theirs["observation"])


def test_a_killed_run_goes_on_from_its_last_save(tmp_path, monkeypatch):
    monkeypatch.setattr(training, "SAVE_INTERVAL", 100)
    args = Args(num_envs=2, total_steps=200, updates_per_step=0.1)
    whole = Run(args, tmp_path)
    whole.train()
    whole.close()

    def killed_at(steps, run):
        sample = run.sample

        def sample_or_die():
            if run.progress.steps == steps:
                raise Kill
            return sample()

        return sample_or_die

    out = tmp_path / "killed"
    out.mkdir()
    killed = Run(args, out)
    killed.sample = killed_at(200, killed)
    with pytest.raises(Kill):
        killed.train()
    killed.close()
    resumed = Run(replace(args, resume=True), out)
    assert resumed.progress.steps == 100
    resumed.train()
    resumed.close()
    torch.testing.assert_close(weights(resumed), weights(whole), rtol=0, atol=0)


def test_other_options_and_other_runs_are_refused(tmp_path):
    args = Args(num_envs=1, total_steps=100, video=False, out=tmp_path)
    run = Run(args, tmp_path)
    run.checkpoint.save()
    run.close()
    for options, message in (
        ({"resume": True, "batch_size": 16}, "batch_size was 256 and is now 16"),
        ({"resume": True, "total_steps": 50}, "total_steps was 100 and is now 50"),
        ({}, "holds a run: continue it with --resume"),
    ):
        with pytest.raises(SystemExit, match=message):
            train.main(replace(args, **options))
    (tmp_path / "resume.pt").unlink()
    with pytest.raises(SystemExit, match="there is no run to resume"):
        train.main(replace(args, resume=True))


def test_a_tenth_of_the_episodes_in_which_nothing_moves_is_stored(tmp_path):
    """The preset "paper" stores all of them."""
    torch.manual_seed(0)
    for preset, low, high in (("paper", 400, 400), ("recipe", 25, 60)):
        keep_unmoved = default_args(preset, "PandaPush-v1").keep_unmoved
        args = Args(env_id="PandaPush-v1", num_envs=2, keep_unmoved=keep_unmoved)
        run = Run(replace(args, total_steps=20_000), tmp_path)
        run.agent.explore.forward = lambda td: td.set("action", torch.zeros(2, 3))
        still = next(iter(run.source.collector))[:1]
        run.close()
        data = torch.cat([still] * 400)
        data["collector", "traj_ids"] = torch.arange(400)[:, None].expand(400, 50)
        run.source.store(data)
        assert low <= len(run.source.buffer) / 50 <= high


def test_critics_of_parts_learn_from_rewards_of_parts(tmp_path, make_demos):
    path = make_demos("PandaStack-v1", episodes=1)
    demos = TensorDict(torch.load(path)).auto_batch_size_(1)
    args = default_args("recipe", "PandaStack-v1")
    assert args.critics == "parts"
    args = replace(args, num_envs=1, updates_per_step=1 / 50, keep_unmoved=1.0)
    run = Run(args, tmp_path, demos)
    run.iterate()
    [(batch, demonstrated)] = run.source.sample(args.batch_size, 1)
    run.close()
    for rows in (batch, demonstrated):
        assert rows["next", "reward"].shape == (len(rows), 2)
    assert run.agent.updates == 1


@pytest.mark.parametrize("algo", ["td3", "sac"])
def test_only_ddpg_has_critics_of_parts(algo):
    assert parse(["--algo", algo, "--env-id", "PandaStack-v1"]).critics == "whole"


def test_ctrl_c_saves_the_run(tmp_path, monkeypatch, capsys):
    sample = Run.sample

    def sample_and_interrupt(run):
        os.kill(os.getpid(), signal.SIGINT)
        return sample(run)

    monkeypatch.setattr(Run, "sample", sample_and_interrupt)
    args = Args(num_envs=2, total_steps=100_000, eval_interval=100, out=tmp_path)
    train.main(replace(args, updates_per_step=0.1))
    output = capsys.readouterr().out
    assert "stopping after this iteration" in output
    assert "with --resume goes on" in output
    assert [row["step"] for row in read_curve(tmp_path)] == ["0", "100"]
    assert torch.load(tmp_path / "resume.pt")["progress"]["steps"] == 100
    assert (tmp_path / "checkpoint.pt").exists()


def test_a_run_ends_well_if_its_video_cannot_be_written(tmp_path, monkeypatch, capsys):
    def fail(*arguments):
        raise OSError("the disk is full")

    monkeypatch.setattr(train, "record", fail)
    train.main(Args(total_steps=50, num_envs=1, updates_per_step=0.0, out=tmp_path))
    output = capsys.readouterr().out
    assert "no video was written: the disk is full" in output
    assert "after 50 steps" in output


def test_the_command_line_overrules_the_recipe():
    args = parse(["--env-id", "PandaSlide-v1", "--gamma", "0.9", "--total-steps=9"])
    recipe = default_args("recipe", "PandaSlide-v1")
    recipe = replace(recipe, total_steps=9, stop_when_solved=False)
    assert args == replace(recipe, gamma=0.9)
    assert args.desired_ratio > 0
    assert parse(["--random-eps", "0.1", "0.2"]).random_eps == (0.1, 0.2)
    assert parse([]) == default_args("recipe", "PandaReach-v1")
    assert parse(["--preset", "paper"]) == Args()


def test_a_number_of_steps_on_the_command_line_is_always_trained():
    assert parse([]).stop_when_solved
    assert not parse(["--total-steps", "4000"]).stop_when_solved
    assert not parse(["--total_steps=4000"]).stop_when_solved


def test_demonstrations_need_the_options_of_the_task(tmp_path, make_demos):
    """They succeed only with the task's own threshold."""
    args = Args(env_id="PandaPush-v1", task_options={"distance_threshold": 10.0})
    with pytest.raises(ValueError, match="of the rewards differ"):
        train.make_run(replace(args, demos=make_demos()), tmp_path)


def test_an_old_run_of_another_machine_goes_on_with_its_label(tmp_path):
    """It is from before an option, and from a machine with more GPUs than this one."""
    args = Args(num_envs=2, total_steps=100, updates_per_step=0.1, video=False)
    args.out = tmp_path
    train.main(args)
    file = tmp_path / "args.json"
    options = {**json.loads(file.read_text()), "label": "few gradient steps"}
    file.write_text(json.dumps(options))
    state = torch.load(tmp_path / "resume.pt")
    del state["args"]["keep_unmoved"]
    state["args"]["device"] = "cuda"
    state["cuda_random"] = [state["random"]] * (torch.cuda.device_count() + 1)
    torch.save(state, tmp_path / "resume.pt")
    train.main(replace(args, resume=True, total_steps=200))
    assert read_curve(tmp_path)[-1]["step"] == "200"
    assert json.loads(file.read_text()) == {**options, "total_steps": 200}


def test_help_shows_the_defaults_of_the_preset(capsys):
    with pytest.raises(SystemExit):
        parse(["--help", "--env-id", "PandaSlide-v1"])
    words = capsys.readouterr().out.split()
    default = words[words.index("--total-steps") :]
    steps = default_args("recipe", "PandaSlide-v1").total_steps
    assert f"{steps})" in default[: default.index("--eval-interval")]


def test_help_separates_what_one_may_change_from_what_research_varies(capsys):
    with pytest.raises(SystemExit):
        parse(["--help"])
    text = capsys.readouterr().out
    run, research = text.split(" run options ")[1].split(" research options ")
    assert "Options that one may want to change" in run
    assert "Options that research varies" in research
    for option in ("--env-id", "--total-steps", "--out", "--seed"):
        assert option in run
    for option in ("--gamma", "--her", "--batch-size"):
        assert option in research
    for option in fields(Args):
        name = "import" if option.name == "imports" else option.name
        assert f"--{name.replace('_', '-')} " in text.replace(",", " ")


@pytest.mark.parametrize("preset", ["paper", "recipe"])
@pytest.mark.parametrize("env_id", ["PandaSlide-v1", "PandaStack-v1"])
def test_crl_draws_geometric_goals_in_every_preset(preset, env_id):
    args = parse(["--algo", "crl", "--preset", preset, "--env-id", env_id])
    recipe = default_args(preset, env_id)
    changes = {"her": "geometric", "desired_ratio": 0.0, "critics": "whole"}
    assert args == replace(recipe, algo="crl", **changes)
    check(args)
    assert parse(["--algo", "crl", "--her", "relabel"]).her == "relabel"
