"""The training example: it learns something, writes its files, stops and resumes."""

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import imageio.v3 as iio
import pytest
import torch

from train import Args, Run

EXAMPLES = Path(__file__).parents[2] / "examples"
QUICK = [
    "--no-video",
    "--eval-interval",
    "200",
    "--eval-episodes",
    "8",
    "--num-envs",
    "4",
]


def command(script, *arguments):
    return [sys.executable, EXAMPLES / f"{script}.py", *map(str, arguments)]


def run(script, *arguments, check=True, **kwargs):
    return subprocess.run(
        command(script, *arguments),
        check=check,
        capture_output=True,
        text=True,
        **kwargs,
    )


def start_until(path, *arguments):
    """Start a training and return it as soon as a file is there."""
    process = subprocess.Popen(
        command("train", *arguments),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 120
    while not path.exists():
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return process


def read_curve(folder):
    with (folder / "curve.csv").open() as file:
        return list(csv.DictReader(file))


def flatten(state, prefix=""):
    """Leaves of nested dictionaries and sequences, by name."""
    if isinstance(state, dict):
        items = state.items()
    elif isinstance(state, (list, tuple)):
        items = enumerate(state)
    else:
        return {prefix: state}
    return {
        name: leaf
        for key, value in items
        for name, leaf in flatten(value, f"{prefix}/{key}").items()
    }


def test_writes_curve_plot_and_checkpoint(tmp_path):
    run("train", "--total-steps", 400, "--out", tmp_path, *QUICK, "--video")
    curve = read_curve(tmp_path)
    assert [row["step"] for row in curve] == ["200", "400"]
    assert all(0 <= float(row["success"]) <= 1 for row in curve)
    assert curve[-1]["updates"] == "200"
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")
    assert len(iio.imread(tmp_path / "video.mp4")) == 51
    logged = (tmp_path / "log" / "scalars" / "success.csv").read_text().split()
    assert [line.split(",")[0] for line in logged] == ["200", "400"]
    checkpoint = torch.load(tmp_path / "checkpoint.pt")
    assert checkpoint["env_id"] == "PandaReach-v1"
    weights = checkpoint["policy"]
    assert all(value.isfinite().all() for value in weights.values())
    assert weights["module.0.module.count"] == 400

    report = run("evaluate", tmp_path, "--episodes", 8).stdout
    assert "PandaReach-v1, 8 episodes" in report
    assert "success at the end" in report
    refused = run("evaluate", tmp_path, "--env-id", "PandaPush-v1", check=False)
    assert refused.returncode == 1
    assert "trained on PandaReach-v1" in refused.stderr
    assert "Traceback" not in refused.stderr
    picture = tmp_path / "all.png"
    run("plot", tmp_path, "--out", picture)
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("algo", "her", "double_q", "critics"),
    [
        ("ddpg", "none", "--double-q", 1),
        ("ddpg", "augment", "--double-q", 1),
        ("td3", "relabel", "--double-q", 2),
        ("td3", "relabel", "--no-double-q", 1),
        ("sac", "relabel", "--double-q", 2),
        ("sac", "relabel", "--no-double-q", 1),
        ("tqc", "relabel", "--double-q", 2),
    ],
)
def test_algorithms_learn(tmp_path, algo, her, double_q, critics):
    run(
        *("train", "--env-id", "PandaPush-v3", "--algo", algo, "--her", her, double_q),
        *("--num-envs", 2, "--total-steps", 100, "--eval-episodes", 2),
        *(
            "--no-video",
            "--batch-size",
            32,
            "--updates-per-step",
            0.1,
            "--out",
            tmp_path,
        ),
    )
    state = torch.load(tmp_path / "resume.pt")
    assert state["updates"] == 10
    weights = state["agent"]
    assert all(value.isfinite().all() for value in weights.values())
    start = torch.load(tmp_path / "resume.pt")["optimizer"]["state"]
    assert all(int(s["step"]) in (5, 10) for s in start.values())
    first_layer = [
        value
        for key, value in weights.items()
        if key.startswith("loss.")
        and "value" in key
        and "target" not in key
        and value.shape[-2:] == (256, 18 + 3 + 3)
    ]
    assert sum(x.shape[0] if x.ndim == 3 else 1 for x in first_layer) == critics
    stored = state["buffer"]["_storage"]["_len"]
    assert stored == (500 if her == "augment" else 100)


def test_resumed_run_equals_uninterrupted_run(tmp_path):
    """Killed without a chance to save anything, then resumed: the same bits."""
    arguments = [*("--total-steps", 600, "--save-interval", 200), *QUICK]
    arguments += ["--updates-per-step", 0.1]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    run("train", *arguments, "--out", whole)
    process = start_until(killed / "resume.pt", *arguments, "--out", killed)
    process.kill()
    process.communicate(timeout=60)
    assert torch.load(killed / "resume.pt")["steps"] < 600
    run("train", *arguments, "--out", killed, "--resume")
    curves = [
        [{**row, "seconds": None} for row in read_curve(folder)]
        for folder in (whole, killed)
    ]
    assert curves[0] == curves[1]
    assert len(curves[0]) == 3
    states = [flatten(torch.load(folder / "resume.pt")) for folder in (whole, killed)]
    assert states[0].keys() == states[1].keys()
    for key, value in states[0].items():
        same = states[1][key]
        if "_storage/_storage/" in key:  # only so much of it is filled
            value, same = value[:600], same[:600]
        # A new collector numbers its trajectories from the start.
        if not key.endswith(("seconds", "collector.traj_ids")):
            equal = (
                torch.equal(value, same) if torch.is_tensor(value) else value == same
            )
            assert equal, key

    for options, message in (
        (("--resume", "--tau", 0.1), "tau was 0.05, is 0.1"),
        ((), "holds a run: continue it with --resume"),
    ):
        refused = run("train", *arguments, "--out", killed, *options, check=False)
        assert refused.returncode == 1
        assert message in refused.stderr
        assert "Traceback" not in refused.stderr
    # It is over: nothing is left to do.
    again = run("train", *arguments, "--out", killed, "--resume")
    assert "after 600 steps" in again.stdout
    assert read_curve(killed)[-1]["step"] == "600"


@pytest.mark.parametrize(
    "options",
    [
        {"algo": "td3"},
        {"algo": "sac"},
        {"algo": "tqc"},
        {"env_id": "PandaPush-v1", "start_at_object": 0.5},
    ],
)
def test_every_kind_of_run_goes_on_from_its_state(tmp_path, options):
    args = Args(**options, num_envs=2, total_steps=200, updates_per_step=0.1)

    def iterate(training):
        training.reseed(training.env)
        data = next(iter(training.collector))
        training.steps += data.numel()
        training.learn(data)

    whole = Run(args, tmp_path)
    iterate(whole)
    whole.save(tmp_path / "resume.pt")
    resumed = Run(args, tmp_path)
    resumed.load(tmp_path / "resume.pt")
    iterate(resumed)
    torch.set_rng_state(torch.load(tmp_path / "resume.pt")["random"])
    iterate(whole)
    for training in (whole, resumed):
        assert training.agent.updates == 20
        training.close()
    torch.testing.assert_close(
        resumed.agent.state_dict(), whole.agent.state_dict(), rtol=0, atol=0
    )


# 150 steps end within an iteration, which is finished.
@pytest.mark.parametrize(("total_steps", "falling"), [(200, 20), (150, 15)])
def test_learning_rate_falls_to_0(tmp_path, total_steps, falling):
    options = {"num_envs": 2, "updates_per_step": 0.1}
    args = Args(total_steps=total_steps, anneal_lr=True, **options)
    training = Run(args, tmp_path)
    (group,) = training.agent.optimizer.param_groups
    rates = []
    update = training.agent.update
    training.agent.update = lambda *batch: rates.append(group["lr"]) or update(*batch)
    for data in training.collector:
        training.steps += data.numel()
        training.learn(data)
        if training.steps >= args.total_steps:
            break
    training.close()
    expected = [1e-3 * max(0, 1 - k / falling) for k in range(20)]
    assert rates == pytest.approx(expected)


def test_interrupt_saves(tmp_path):
    arguments = ["--total-steps", "100000", "--out", str(tmp_path), *QUICK]
    process = start_until(tmp_path / "curve.csv", *arguments)
    os.kill(process.pid, signal.SIGINT)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    assert "stopping after this iteration" in output
    assert "with --resume goes on" in output
    steps = int(read_curve(tmp_path)[-1]["step"])
    assert torch.load(tmp_path / "resume.pt")["steps"] >= steps
    assert (tmp_path / "checkpoint.pt").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--env-id", "PandaFly-v1"), "unknown environment id 'PandaFly-v1'"),
        (("--resume",), "there is no run to resume"),
        (("--total-steps", "0"), "total_steps must be positive"),
        (("--demos", "nofile.pt"), "there is no file nofile.pt"),
        (("--pretrain-updates", "9"), "pretrain_updates needs demos to imitate"),
        (("--fine-inputs", "0.03"), "fine_inputs needs relative_inputs"),
        (("--out", "/dev/null"), "out must be a folder, got the file /dev/null"),
    ],
)
def test_bad_input_is_one_line(tmp_path, arguments, message):
    result = run("train", *arguments, cwd=tmp_path, check=False)
    assert result.returncode == 1
    assert message in result.stderr
    assert "Traceback" not in result.stderr
    assert not (tmp_path / "runs").exists()
