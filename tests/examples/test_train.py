"""The training example: it learns something, writes its files, and stops cleanly."""

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import torch

TRAIN = Path(__file__).parents[2] / "examples" / "train.py"
QUICK = ["--eval-interval", "200", "--eval-episodes", "8", "--num-envs", "4"]


def read_curve(folder):
    with (folder / "curve.csv").open() as file:
        return list(csv.DictReader(file))


def test_writes_curve_plot_and_checkpoint(tmp_path):
    arguments = ["--total-steps", "400", "--out", str(tmp_path), *QUICK]
    subprocess.run([sys.executable, TRAIN, *arguments], check=True, cwd=tmp_path)
    curve = read_curve(tmp_path)
    assert [row["step"] for row in curve] == ["200", "400"]
    assert all(0 <= float(row["success"]) <= 1 for row in curve)
    assert curve[-1]["updates"] == "200"
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")
    checkpoint = torch.load(tmp_path / "checkpoint.pt")
    assert checkpoint["env_id"] == "PandaReach-v1"
    weights = checkpoint["networks"]
    assert all(value.isfinite().all() for value in weights.values())
    assert weights["actor.module.0.module.count"] == 400


def test_interrupt_saves(tmp_path):
    arguments = ["--total-steps", "100000", "--out", str(tmp_path), *QUICK]
    process = subprocess.Popen(
        [sys.executable, TRAIN, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 120
    while not (tmp_path / "curve.csv").exists():
        assert time.monotonic() < deadline
        time.sleep(0.1)
    os.kill(process.pid, signal.SIGINT)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    assert "interrupted after" in output
    assert read_curve(tmp_path)
    assert (tmp_path / "checkpoint.pt").exists()


def test_unknown_id_is_one_line(tmp_path):
    result = subprocess.run(
        [sys.executable, TRAIN, "--env-id", "PandaFly-v1"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
    )
    assert result.returncode == 1
    assert "unknown environment id 'PandaFly-v1'" in result.stderr
    assert "Traceback" not in result.stderr
    assert not (tmp_path / "runs").exists()
