"""``train --offline`` writes its files, stops, resumes and explains errors."""

import json
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

import torch_panda
from tests.commands.runs import After, points, read_curve, weights
from tests.devices import DEVICES
from torch_panda.bullet import FAST
from torch_panda.commands import plot, train
from torch_panda.commands.train import parse
from torch_panda.learning import sources
from torch_panda.learning.options import Args, default_args
from torch_panda.learning.recipes import OFFLINE
from torch_panda.learning.sources import draw_batches
from torch_panda.learning.training import Training

pytestmark = pytest.mark.usefixtures("quick")

SMALL = {"batch_size": 64, "num_envs": 4, "video": False}


def make_args(out, algo="gcbc", **options):
    options = {**SMALL, "transitions": 200, "total_steps": 6, **options}
    args = default_args("offline", "PandaReach-v1", algo)
    return replace(args, out=out, eval_interval=4, **options)


def test_the_run_writes_its_files_and_its_policy_can_be_used(tmp_path, capsys):
    out = tmp_path / "run"
    train.main(make_args(out))
    assert "after 6 steps; see" in capsys.readouterr().out
    rows = read_curve(out)
    assert [row["step"] for row in rows] == ["0", "4", "6"]
    assert float(rows[-1]["actor_loss"]) > 0
    assert 0 <= float(rows[-1]["fixed_success"]) <= 1
    assert set(torch_panda.evaluation_tasks("PandaReach-v1")) <= set(rows[0])
    assert (out / "curve.png").read_bytes().startswith(b"\x89PNG")
    args = json.loads((out / "args.json").read_text())
    assert (args["preset"], args["algo"]) == ("offline", "gcbc")

    policy = torch_panda.load_policy(out)
    result = torch_panda.evaluate(policy, "PandaReach-v1", episodes=2)
    assert len(result.success) == 2
    assert list(plot.read_runs([tmp_path])) == ["PandaReach-v1, offline"]


def test_the_normaliser_knows_the_data_before_the_first_step(tmp_path):
    args = make_args(tmp_path)
    run = train.make_run(args, args.out)
    run.close()
    rows, normalizer = run.source.data.rows, run.agent.normalizer
    assert normalizer.count == len(rows) == 200
    for columns, values in (
        (slice(0, 6), rows["observation"]),
        (slice(6, 9), rows["next", "achieved_goal"]),
    ):
        mean, std = normalizer.mean[columns], values.std(0)
        assert ((mean - values.mean(0)).abs() < 0.5 * std + 0.01).all()
        ratio = normalizer.std[columns] / std.clamp(min=0.01)
        assert ((ratio > 0.5) & (ratio < 2)).all()


@pytest.mark.parametrize("device", DEVICES)
def test_a_resumed_offline_run_equals_an_uninterrupted_run(tmp_path, device):
    """HIQL has target networks, and draws random numbers beside those of the data."""
    args = make_args(tmp_path / "whole", "hiql", device=device)
    whole = train.make_run(args, args.out)
    assert whole.train()
    whole.close()

    args = make_args(tmp_path / "stopped", "hiql", device=device)
    stopped = train.make_run(args, args.out)
    # On a GPU, an iteration is two gradient steps.
    assert not stopped.train(After(2 if device == "cpu" else 0))
    stopped.close()
    steps = stopped.progress.steps
    assert steps == (3 if device == "cpu" else 2)
    resumed = train.make_run(replace(args, resume=True), args.out)
    assert resumed.progress.steps == steps
    assert resumed.train()
    resumed.close()
    torch.testing.assert_close(weights(resumed), weights(whole), rtol=0, atol=0)
    assert points(resumed) == points(whole)
    assert [row["step"] for row in points(whole)] == [0, 4, 6]


def read_weights(folder):
    """The weights of a run's policy."""
    return torch.load(folder / "checkpoint.pt")["policy"]


def test_seeds_learn_together_as_each_would_alone(tmp_path, capsys):
    train.main(make_args(tmp_path / "run", seeds=(0, 3), total_steps=4))
    printed = capsys.readouterr().out
    for seed in (0, 3):
        out, alone = tmp_path / f"run-{seed}", tmp_path / f"alone-{seed}"
        assert f"after 4 steps; see {out}" in printed
        train.main(make_args(alone, seed=seed, total_steps=4))
        data, expected = (torch.load(path / "data.pt") for path in (out, alone))
        assert torch.equal(data["action"], expected["action"])
        rows, expected = read_curve(out), read_curve(alone)
        for row in rows + expected:
            del row["seconds"]
        numbers = [[float(x or 0) for x in row.values()] for row in rows]
        expected = [[float(x or 0) for x in row.values()] for row in expected]
        assert numbers == [pytest.approx(row, rel=1e-3) for row in expected]
        torch.testing.assert_close(
            read_weights(out), read_weights(alone), rtol=1e-3, atol=1e-5
        )
        options = json.loads((out / "args.json").read_text())
        assert (options["seed"], options["seeds"]) == (seed, [])
    first, second = (read_curve(tmp_path / f"run-{seed}") for seed in (0, 3))
    assert first[1]["actor_loss"] != second[1]["actor_loss"]


def test_resumed_seeds_equal_uninterrupted_ones(tmp_path):
    def make_runs(out, **options):
        args = make_args(out, "hiql", seeds=(0, 3), total_steps=4, **options)
        folders = train.find_folders(args).items()
        return Training([train.make_run(options, out) for out, options in folders])

    whole = make_runs(tmp_path / "whole")
    assert whole.train()
    whole.close()
    stopped = make_runs(tmp_path / "stopped")
    assert not stopped.train(After(2))
    stopped.close()
    assert [run.progress.steps for run in stopped.runs] == [3, 3]
    resumed = make_runs(tmp_path / "stopped", resume=True)
    assert resumed.train()
    resumed.close()
    for run, expected in zip(resumed.runs, whole.runs, strict=True):
        torch.testing.assert_close(weights(run), weights(expected), rtol=0, atol=0)
        assert points(run) == points(expected)


def test_seeds_with_different_numbers_of_steps_are_refused(tmp_path):
    train.main(make_args(tmp_path / "run-0", seed=0, total_steps=1))
    train.main(make_args(tmp_path / "run-3", seed=3, total_steps=2))
    args = make_args(tmp_path / "run", seeds=(0, 3), total_steps=2, resume=True)
    with pytest.raises(SystemExit, match=r"number of steps, got 1, 2: continue each"):
        train.main(args)


def test_the_curve_has_mean_losses_if_batches_are_drawn_at_once(tmp_path, monkeypatch):
    """As on a GPU, where an iteration is more than one gradient step."""
    monkeypatch.setattr(sources, "drawn_at_once", lambda device: 6)
    run = train.make_run(make_args(tmp_path), tmp_path)
    losses, update = [], run.agent.update
    run.agent.update = lambda *batches: losses.append(update(*batches)) or losses[-1]
    assert run.train()
    run.close()
    assert run.source.collect() == 2  # divides 4 steps and 6 steps
    losses = [loss["actor_loss"].item() for loss in losses]
    assert len({*losses}) == 6
    rows = [(row["step"], row.get("actor_loss")) for row in run.progress.curve]
    means = [(4, sum(losses[:4]) / 4), (6, sum(losses[4:]) / 2)]
    assert rows[1:] == [(step, pytest.approx(mean)) for step, mean in means]


def test_batches_drawn_at_once_have_their_size():
    sizes = []

    def draw(size):
        sizes.append(size)
        return TensorDict({"x": torch.rand(size)}, [size])

    for device, expected in (("cpu", [8] * 250), ("cuda", [800, 800, 400])):
        batches = [*draw_batches(draw, 8, 250, torch.device(device))]
        assert [len(batch) for batch in batches] == [8] * 250
        assert len(torch.cat(batches)["x"].unique()) > 1_900
        assert sizes == expected
        sizes.clear()


def test_a_file_trains_as_its_data_do_and_a_changed_file_is_refused(tmp_path):
    first = make_args(tmp_path / "first", total_steps=2)
    train.main(first)
    data = tmp_path / "first" / "data.pt"
    unused = {"transitions": Args.transitions, "num_envs": OFFLINE["num_envs"]}
    out = tmp_path / "second"
    args = make_args(out, data=str(data), total_steps=2, **unused)
    train.main(args)
    runs = [tmp_path / name for name in ("first", "second")]
    ours, theirs = map(read_weights, runs)
    torch.testing.assert_close(ours, theirs, rtol=0, atol=0)
    content = torch.load(data)
    content["action"] *= 0.5
    torch.save(content, data)
    with pytest.raises(SystemExit, match="cannot resume with other data"):
        train.main(replace(args, resume=True))


def test_generated_data_overwrite_no_file(tmp_path):
    file = tmp_path / "data.pt"
    file.write_text("precious")
    with pytest.raises(SystemExit, match="generated data would overwrite"):
        train.main(make_args(tmp_path))
    assert file.read_text() == "precious"


def test_physics_and_options_of_the_task_hold_in_data_and_evaluations(tmp_path):
    options = {"physics": "fast", "task_options": {"distance_threshold": 10.0}}
    args = make_args(tmp_path, **options)
    run = train.make_run(args, tmp_path)
    run.close()
    assert (torch.load(tmp_path / "data.pt")["next"]["reward"] == 0).all()
    for env in (run.env, run.curve.env):
        assert env.physics == FAST
        assert env.task.distance_threshold == 10.0


def test_the_command_line_sets_the_options():
    options = ["--algo", "hiql", "--alpha", "7", "--data", "play"]
    args = parse(["--offline", *options])
    default = default_args("offline", "PandaReach-v1", "hiql")
    assert args == replace(default, alpha=7.0, data="play")
    assert parse(["--offline"]).algo == "gcivl"
