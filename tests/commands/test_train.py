"""A training writes its files, stops and resumes."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import pytest
import torch

from tests.commands.runs import After, Kill, points, read_curve, weights
from tests.devices import DEVICES
from torch_panda.commands import evaluate, plot, train
from torch_panda.commands.train import parse
from torch_panda.learning import training
from torch_panda.learning.agents.base import LEARNING_RATE
from torch_panda.learning.options import Args, check, default_args
from torch_panda.learning.training import Run

pytestmark = pytest.mark.usefixtures("quick")


def test_a_training_writes_files_that_other_commands_read(tmp_path, capsys):
    out = tmp_path / "run"
    train.main(Args(total_steps=400, eval_interval=200, out=out, noise_eps=0.1))
    assert "after 400 steps; see" in capsys.readouterr().out
    rows = read_curve(out)
    assert [row["step"] for row in rows] == ["0", "200", "400"]
    assert all(0 <= float(row["success"]) <= 1 for row in rows)
    assert [row["updates"] for row in rows] == ["0", "100", "200"]
    assert rows[0]["critic_loss"] == ""
    assert float(rows[-1]["critic_loss"]) > 0
    assert json.loads((out / "args.json").read_text())["changed"] == {"noise_eps": 0.1}
    assert (out / "curve.png").read_bytes().startswith(b"\x89PNG")
    assert len(iio.imread(out / "video.mp4")) == 51
    content = torch.load(out / "checkpoint.pt", weights_only=True)
    assert content["env_id"] == "PandaReach-v1"
    assert all(value.isfinite().all() for value in content["policy"].values())
    assert content["policy"]["module.0.module.count"] == 400
    assert (out / "checkpoint.pt").stat().st_size < 2 * 2**20

    options = {"distance_threshold": 10.0}
    evaluate.main(evaluate.Args(run=out, episodes=8, task_options=options))
    assert "success at the end   100.0%" in capsys.readouterr().out
    evaluate.main(evaluate.Args(run=out, episodes=8))
    report = capsys.readouterr().out
    assert "PandaReach-v1, 8 episodes" in report
    assert "success at the end" in report
    with pytest.raises(SystemExit, match="where observation has size 6, got 18"):
        evaluate.main(evaluate.Args(run=out, env_id="PandaPush-v1"))
    plot.main(plot.Args(runs=[tmp_path], out=tmp_path / "all.png"))
    assert (tmp_path / "all.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    "options",
    [
        {"algo": "td3"},
        {"algo": "sac"},
        {"algo": "tqc"},
        {"algo": "crl", "her": "geometric"},
        {"her": "none", "random_eps": (0.1, 0.9)},
        {"preset": "tuned", "relative_inputs": "fine", "augmentation": "mirror-shift"},
        {"start_at_object": 0.5, "target_interval": 3, "network": "layer-norm"},
        {"desired_ratio": 0.5, "anneal_lr": True},
        {"exploration": "points", "ema_rate": 0.1},
    ],
    ids=lambda options: "-".join(map(str, options.values())),
)
def test_a_resumed_run_equals_an_uninterrupted_run_bit_for_bit(
    tmp_path, options, device
):
    args = Args(env_id="PandaPush-v1", num_envs=2, total_steps=300, **options)
    args = replace(args, updates_per_step=0.1, eval_interval=100, device=device)
    whole = Run(args, tmp_path)
    assert whole.train()
    whole.close()
    assert whole.agent.updates == 30
    assert [row["step"] for row in whole.progress.curve] == [0, 100, 200, 300]

    (tmp_path / "stopped").mkdir()
    stopped = Run(args, tmp_path / "stopped")
    assert not stopped.train(After(1))
    stopped.close()
    assert stopped.progress.steps == 200
    resumed = Run(replace(args, resume=True), tmp_path / "stopped")
    assert resumed.progress.steps == 200
    assert resumed.train()
    resumed.close()
    torch.testing.assert_close(weights(resumed), weights(whole), rtol=0, atol=0)
    assert points(resumed) == points(whole)
    length = len(whole.buffer)
    assert len(resumed.buffer) == length
    for key in ("observation", "desired_goal", "action", ("next", "reward")):
        ours = resumed.buffer.storage[:length][key]
        assert torch.equal(ours, whole.buffer.storage[:length][key])
    again = Run(replace(args, resume=True), tmp_path / "stopped")
    assert again.train(), "nothing is left to do"
    again.close()
    torch.testing.assert_close(weights(again), weights(whole), rtol=0, atol=0)


def test_a_finished_run_continues_with_more_steps(tmp_path):
    """The result is that of a run that had all steps from the start."""
    args = Args(env_id="PandaPush-v1", num_envs=2, total_steps=200, video=False)
    args = replace(args, updates_per_step=0.1, eval_interval=100)
    whole = Run(replace(args, total_steps=400), tmp_path)
    whole.train()
    whole.close()

    args.out = tmp_path / "continued"
    train.main(args)
    train.main(replace(args, resume=True, total_steps=400))
    written = json.loads((args.out / "args.json").read_text())
    assert written["total_steps"] == 400
    continued = Run(replace(args, resume=True, total_steps=400), args.out)
    continued.close()
    torch.testing.assert_close(weights(continued), weights(whole), rtol=0, atol=0)
    assert points(continued) == points(whole)
    assert len(continued.buffer) == len(whole.buffer)
    for ours, theirs in zip(continued.buffer[:], whole.buffer[:], strict=True):
        assert torch.equal(ours["observation"], theirs["observation"])


def test_a_killed_run_goes_on_from_its_last_save(tmp_path, monkeypatch):
    monkeypatch.setattr(training, "SAVE_INTERVAL", 200)
    args = Args(num_envs=2, total_steps=400, updates_per_step=0.1)
    whole = Run(args, tmp_path)
    whole.train()
    whole.close()

    def killed_at(steps, run):
        learn = run.learn

        def learn_or_die():
            if run.progress.steps == steps:
                raise Kill
            return learn()

        return learn_or_die

    for after, saved in ((300, 200), (100, 0)):
        out = tmp_path / str(after)
        out.mkdir()
        killed = Run(args, out)
        killed.learn = killed_at(after, killed)
        with pytest.raises(Kill):
            killed.train()
        killed.close()
        resumed = Run(replace(args, resume=True), out)
        assert resumed.progress.steps == saved
        resumed.train()
        resumed.close()
        torch.testing.assert_close(weights(resumed), weights(whole), rtol=0, atol=0)


def test_other_options_and_other_runs_are_refused(tmp_path):
    args = Args(num_envs=2, total_steps=100, updates_per_step=0.1, video=False)
    args.out = tmp_path
    train.main(args)
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


def test_a_falling_learning_rate_needs_the_same_total_steps(tmp_path):
    args = Args(num_envs=2, total_steps=100, updates_per_step=0.0, anneal_lr=True)
    args = replace(args, video=False, out=tmp_path)
    train.main(args)
    with pytest.raises(SystemExit, match="total_steps was 100 and is now 200"):
        train.main(replace(args, resume=True, total_steps=200))


def test_a_resumed_run_keeps_its_label(tmp_path):
    args = Args(num_envs=2, total_steps=100, updates_per_step=0.0, video=False)
    args.out = tmp_path
    train.main(args)
    file = tmp_path / "args.json"
    options = {**json.loads(file.read_text()), "label": "no gradient steps"}
    file.write_text(json.dumps(options))
    train.main(replace(args, resume=True))
    assert json.loads(file.read_text()) == options


# 150 steps end within an iteration, which is finished.
@pytest.mark.parametrize(("total_steps", "falling"), [(200, 20), (150, 15)])
def test_the_learning_rate_falls_to_0(tmp_path, total_steps, falling):
    options = {"num_envs": 2, "updates_per_step": 0.1}
    run = Run(Args(total_steps=total_steps, anneal_lr=True, **options), tmp_path)
    (group,) = run.agent.optimizer.param_groups
    rates, update = [], run.agent.update
    run.agent.update = lambda *batch: rates.append(group["lr"]) or update(*batch)
    run.train()
    run.close()
    expected = [LEARNING_RATE * max(0, 1 - k / falling) for k in range(20)]
    assert rates == pytest.approx(expected)


def test_episodes_in_which_nothing_moves_are_left_out(tmp_path, monkeypatch):
    monkeypatch.setattr(training, "KEEP_UNMOVED", 0.0)
    options = {"env_id": "PandaPush-v1", "num_envs": 2, "total_steps": 100}
    for preset, stored in (("paper", 100), ("tuned", 0)):
        run = Run(Args(preset=preset, **options), tmp_path)
        run.agent.explore.forward = lambda td: td.set("action", torch.zeros(2, 3))
        run.store(next(iter(run.collector)))
        assert len(run.buffer) == stored
        run.progress.steps = 100
        assert bool(run.learn()) == bool(stored)
        run.close()


def test_ctrl_c_saves_the_run(tmp_path):
    """In a process of its own."""
    out = tmp_path / "run"
    command = ["-m", "torch_panda", "train", "--total-steps", "100000", "--out", out]
    process = subprocess.Popen(
        [sys.executable, *map(str, command), "--eval-interval", "200"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        deadline = time.monotonic() + 120
        while not (out / "curve.csv").exists() or len(read_curve(out)) < 2:
            assert process.poll() is None, process.communicate()[1]
            assert time.monotonic() < deadline
            time.sleep(0.05)
        os.kill(process.pid, signal.SIGINT)
        output, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0, errors
    assert "stopping after this iteration" in output
    assert "with --resume goes on" in output
    steps = int(read_curve(out)[-1]["step"])
    assert torch.load(out / "resume.pt")["progress"]["steps"] >= steps > 0
    assert (out / "checkpoint.pt").exists()


def test_a_run_ends_well_if_its_video_cannot_be_written(tmp_path, monkeypatch, capsys):
    def fail(*arguments):
        raise OSError("the disk is full")

    monkeypatch.setattr(train, "record", fail)
    train.main(Args(total_steps=100, num_envs=2, updates_per_step=0.0, out=tmp_path))
    output = capsys.readouterr().out
    assert "no video was written: the disk is full" in output
    assert "after 100 steps" in output


def test_the_command_line_overrules_the_recipe():
    args = parse(["--preset", "tuned", "--env-id", "PandaSlide-v1", "--gamma", "0.9"])
    recipe = default_args("tuned", "PandaSlide-v1")
    assert args == replace(recipe, gamma=0.9)
    assert args.desired_ratio > 0
    assert parse(["--random-eps", "0.1", "0.2"]).random_eps == (0.1, 0.2)
    assert parse([]) == Args()


def test_help_shows_the_defaults_of_the_preset(capsys):
    with pytest.raises(SystemExit):
        parse(["--help", "--preset", "tuned", "--env-id", "PandaSlide-v1"])
    words = capsys.readouterr().out.split()
    default = words[words.index("--total-steps") :]
    steps = default_args("tuned", "PandaSlide-v1").total_steps
    assert f"{steps})" in default[: default.index("--eval-interval")]


@pytest.mark.parametrize("preset", ["paper", "tuned", "sample-efficient"])
@pytest.mark.parametrize("env_id", ["PandaSlide-v1", "PandaStack-v1"])
def test_crl_draws_geometric_goals_in_every_preset(preset, env_id):
    args = parse(["--algo", "crl", "--preset", preset, "--env-id", env_id])
    recipe = default_args(preset, env_id)
    assert args == replace(recipe, algo="crl", her="geometric", desired_ratio=0.0)
    check(args)
    assert parse(["--algo", "crl", "--her", "relabel"]).her == "relabel"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"env_id": "PandaFly-v1"}, "unknown environment id 'PandaFly-v1'"),
        ({"resume": True}, "there is no run to resume"),
        ({"total_steps": 0}, "total_steps must be positive"),
        (
            {"demos": Path("nofile.pt")},
            "there is no file or folder nofile.pt: ",
        ),
        ({"pretrain_updates": 9}, "pretrain_updates needs demonstrations: pass"),
        (
            {"demos": Path("nofile.pt"), "batch_size": 3},
            "batch_size must be at least 4 with demos",
        ),
        ({"noise_eps": 0.0, "random_eps": (0.0, 0.0)}, "algo ddpg explores by"),
        ({"algo": "crl"}, "--her geometric --desired-ratio 0"),
        (
            {"algo": "crl", "her": "geometric", "demos": Path("nofile.pt")},
            "algo crl cannot use demonstrations",
        ),
        ({"her": "parts"}, "--her parts needs goals of several objects"),
        ({"start_at_object": 0.5}, "start_at_object needs end-effector control"),
        ({"out": Path("/dev/null")}, "out must be a folder, got the file /dev/null"),
    ],
)
def test_bad_options_of_a_training_end_with_one_line(
    tmp_path, monkeypatch, options, message
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match=message) as stop:
        train.main(Args(**options))
    assert "\n" not in str(stop.value)
    assert not (tmp_path / "runs").exists()
