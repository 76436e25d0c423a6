"""The plotting example: what it draws, and what it cannot."""

import csv
import json
from dataclasses import asdict
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

import plot
from train import Args


@pytest.fixture
def runs(tmp_path):
    for seed in range(2):
        folder = tmp_path / "runs" / str(seed)
        folder.mkdir(parents=True)
        (folder / "args.json").write_text(json.dumps(asdict(Args(seed=seed))))
        with (folder / "curve.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, ["step", "success", "ever_success", "return"])
            writer.writeheader()
            writer.writerow(dict.fromkeys(writer.fieldnames, 0.5) | {"return": -40.0})
    return tmp_path / "runs"


@pytest.mark.parametrize(
    ("metric", "label", "shown"),
    [
        ("success", "success rate", 0.5),
        ("ever_success", "success rate at any step", 0.5),
        ("return", "return", -40.0),
    ],
)
def test_every_metric_is_seen(runs, tmp_path, monkeypatch, metric, label, shown):
    figures = []
    monkeypatch.setattr(plt, "close", figures.append)
    plot.main(plot.Args(runs=[runs], metric=metric, out=tmp_path / "new" / "curves"))
    monkeypatch.undo()
    assert (tmp_path / "new" / "curves.png").read_bytes().startswith(b"\x89PNG")
    (axes,) = figures[0].axes
    assert axes.get_ylabel() == label
    low, high = axes.get_ylim()
    assert low < shown < high
    assert axes.lines[0].get_ydata().tolist() == [shown]
    plt.close("all")


def spoil_arguments(folder):
    (folder / "args.json").unlink()


def spoil_curve(folder):
    (folder / "curve.csv").write_text("step,success\n100,abc\n")


@pytest.mark.parametrize("spoil", [spoil_arguments, spoil_curve])
def test_a_folder_that_holds_no_run_is_named(runs, tmp_path, spoil):
    spoil(runs / "1")
    with pytest.raises(SystemExit, match=f"^cannot draw: {runs / '1'} holds no run: "):
        plot.main(plot.Args(runs=[runs], out=tmp_path / "curves.png"))


def test_no_run_and_no_place(runs, tmp_path):
    with pytest.raises(SystemExit, match=r"no run .* below nowhere$"):
        plot.main(plot.Args(runs=[Path("nowhere")], out=tmp_path / "curves.png"))
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit, match=r"^cannot draw: \[Errno"):
        plot.main(plot.Args(runs=[runs], out=tmp_path / "file" / "curves.png"))
