"""The plotting example: what it draws, and what it cannot."""

import csv
import json
from pathlib import Path

import pytest

from torch_panda.commands import plot
from torch_panda.learning import plots
from torch_panda.learning.files.run_files import write_options
from torch_panda.learning.options import Args, default_args
from torch_panda.learning.recipes import find_changes

POINT = {"step": 0.5, "success": 0.5, "ever_success": 0.5, "return": -40.0}


def write_run(folder, args, rows=(POINT,)):
    write_options(folder, args, default_args(args.preset, args.env_id))
    with (folder / "curve.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, [*rows[-1]])
        writer.writeheader()
        writer.writerows(rows)


@pytest.fixture
def runs(tmp_path):
    for seed in range(2):
        write_run(tmp_path / "runs" / str(seed), Args(seed=seed))
    return tmp_path / "runs"


@pytest.fixture
def figures(monkeypatch):
    """The figures that would be written."""
    drawn = []
    monkeypatch.setattr(plots, "save", lambda figure, path: drawn.append(figure))
    return drawn


@pytest.mark.parametrize(
    ("metric", "label", "shown"),
    [
        ("success", "success rate", 0.5),
        ("ever_success", "success rate at any step", 0.5),
        ("return", "return", -40.0),
    ],
)
def test_every_metric_is_drawn_inside_its_axes(
    runs, tmp_path, figures, metric, label, shown
):
    plot.main(plot.Args(runs=[runs], metric=metric, out=tmp_path / "curves.png"))
    (axes,) = figures[0].axes
    assert axes.get_ylabel() == label
    low, high = axes.get_ylim()
    assert low < shown < high
    assert axes.lines[0].get_ydata().tolist() == [shown]


def test_a_picture_gets_an_ending_and_a_folder(runs, tmp_path):
    plot.main(plot.Args(runs=[runs], out=tmp_path / "new" / "curves"))
    assert (tmp_path / "new" / "curves.png").read_bytes().startswith(b"\x89PNG")


def lines_of(axes):
    return [line.get_label() for line in axes.lines]


def test_a_task_has_one_panel_with_a_line_for_each_set_of_options(tmp_path, figures):
    ways = ({}, {"her": "none"}, {"double_q": False}, {"demos": Path("demos.pt")})
    for algo in ("td3", "sac"):
        for index, way in enumerate(ways):
            for seed in range(2):
                args = Args(env_id="PandaPush-v1", algo=algo, seed=seed, **way)
                write_run(tmp_path / f"{algo}-{index}-{seed}", args)
    for task in ("Reach", "Slide", "Stack"):
        write_run(tmp_path / task, Args(env_id=f"Panda{task}-v1"))
    plot.main(plot.Args(runs=[tmp_path], out=tmp_path / "curves.png"))
    panels = {axes.get_title(): axes for axes in figures[0].axes}
    tasks = ("Push", "Reach", "Slide", "Stack")
    assert list(panels) == [f"Panda{task}-v1" for task in tasks]
    options = ("paper", "paper, demos", "paper, no double q", "paper, no her")
    assert lines_of(panels["PandaPush-v1"]) == [
        f"{algo}, {way} (2 seeds)" for algo in ("SAC", "TD3") for way in options
    ]
    assert lines_of(panels["PandaStack-v1"]) == ["DDPG, paper (1 seed)"]
    assert len({line.get_color() for line in panels["PandaPush-v1"].lines}) == 8
    figures[0].draw_without_rendering()  # places the panels
    rows = {round(axes.get_position().y0, 2) for axes in figures[0].axes}
    assert len(rows) == 2  # three panels are side by side


def test_a_label_in_the_options_names_the_line(tmp_path, figures):
    for seed, label in ((0, "strong"), (1, "strong"), (2, None)):
        write_run(tmp_path / str(seed), Args(seed=seed, gamma=0.9, noise_eps=0.1))
        options = json.loads((tmp_path / str(seed) / "args.json").read_text())
        if label:
            options["label"] = label
        (tmp_path / str(seed) / "args.json").write_text(json.dumps(options))
    plot.main(plot.Args(runs=[tmp_path], out=tmp_path / "curves.png"))
    assert lines_of(figures[0].axes[0]) == [
        "DDPG, paper, gamma 0.9, noise eps 0.1 (1 seed)",
        "DDPG, strong (2 seeds)",
    ]


def test_a_long_label_leaves_room_to_its_panel(tmp_path, figures):
    way = {"gamma": 0.9, "noise_eps": 0.1, "batch_size": 64, "ema_rate": 0.01}
    way |= {"desired_ratio": 0.5, "updates_per_step": 0.2, "randomize": 3.0}
    args = Args(env_id="PandaPush-v1", num_envs=9, start_at_reached=0.5, **way)
    write_run(tmp_path / "way", args)
    for task in ("Reach", "Slide"):
        write_run(tmp_path / task, Args(env_id=f"Panda{task}-v1"))
    plot.main(plot.Args(runs=[tmp_path], out=tmp_path / "curves.png"))
    figures[0].draw_without_rendering()  # places the panels
    assert all(axes.get_position().width > 0.2 for axes in figures[0].axes)
    (label,) = lines_of(figures[0].axes[0])
    assert "gamma 0.9" in label
    assert "randomize 3.0" in label


def test_a_band_covers_the_steps_that_all_seeds_have(tmp_path, figures):
    curves = [
        {0: 0.0, 100: 0.2, 200: 0.4, 300: 0.6},
        {0: 0.1, 200: 0.8},  # evaluated less often
        {0: 0.2, 100: 0.5, 200: 0.6, 300: 0.7, 400: 1.0},
    ]
    for seed, curve in enumerate(curves):
        rows = [{"step": step, "success": value} for step, value in curve.items()]
        write_run(tmp_path / str(seed), Args(seed=seed), rows)
    plot.main(plot.Args(runs=[tmp_path], out=tmp_path / "curves.png"))
    (axes,) = figures[0].axes
    (line,) = axes.lines
    assert line.get_xydata().tolist() == [[0, 0.1], [200, 0.6]]
    (band,) = axes.collections
    heights = {tuple(point) for point in band.get_paths()[0].vertices.round(6).tolist()}
    assert {(0.0, 0.05), (0.0, 0.15), (200.0, 0.5), (200.0, 0.7)} <= heights


def spoil_arguments(folder):
    (folder / "args.json").write_text("{}")


def spoil_curve(folder):
    (folder / "curve.csv").write_text("step,success\n100,abc\n")


def spoil_columns(folder):
    (folder / "curve.csv").write_text("step,return\n100,-40\n")


@pytest.mark.parametrize("spoil", [spoil_arguments, spoil_curve, spoil_columns])
def test_a_run_that_cannot_be_read_is_named(runs, tmp_path, spoil):
    spoil(runs / "1")
    with pytest.raises(
        SystemExit, match=f"^cannot draw: cannot read the run {runs / '1'}: "
    ):
        plot.main(plot.Args(runs=[runs], out=tmp_path / "curves.png"))


def test_a_folder_without_options_is_left_out(runs, tmp_path, figures):
    (runs / "1" / "args.json").unlink()
    plot.main(plot.Args(runs=[runs], out=tmp_path / "curves.png"))
    (axes,) = figures[0].axes
    assert lines_of(axes) == ["DDPG, paper (1 seed)"]


def test_an_unwritable_place_is_refused(runs, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit, match=r"^cannot draw: \[Errno"):
        plot.main(plot.Args(runs=[runs], out=tmp_path / "file" / "curves.png"))


def test_runs_with_another_logger_have_the_same_label():
    assert find_changes(Args(logger="tensorboard"), Args()) == {}
