"""Tests of training logs: their values, and logs that a resumed run continues."""

import csv

import pytest

from torch_panda.commands import train
from torch_panda.learning.files import logger as logger_module
from torch_panda.learning.options import Args
from torch_panda.learning.training import Run

pytestmark = pytest.mark.usefixtures("quick")


def make_args(out, **options):
    options = {"total_steps": 100, "eval_interval": 100, "num_envs": 2, **options}
    return Args(out=out, video=False, updates_per_step=0.05, **options)


class Recorder:
    """Replaces a torchrl logger and records the calls of its methods."""

    def __init__(self, name, *arguments, **options):
        self.name, self.options, self.experiment = name, options, self
        self.values, self.is_closed = [], False
        LOGGERS.append(self)

    def log_scalar(self, key, value, step):
        self.values.append((step, key, value))

    def close(self):
        self.is_closed = True

    finish = close


LOGGERS: list[Recorder] = []


@pytest.fixture
def loggers(monkeypatch):
    monkeypatch.setattr(logger_module, "find_spec", lambda name: True)
    monkeypatch.setattr(logger_module, "TensorboardLogger", Recorder)
    monkeypatch.setattr(logger_module, "WandbLogger", Recorder)
    LOGGERS.clear()
    return LOGGERS


def read_curve(out):
    """The step, column and number of each entry of a curve."""
    return [
        (int(row["step"]), key, float(value))
        for row in csv.DictReader((out / "curve.csv").open())
        for key, value in row.items()
        if key != "step" and value
    ]


def test_a_resumed_run_continues_its_log(tmp_path, loggers):
    out = tmp_path / "run"
    args = make_args(out, logger="wandb")
    run = Run(args, out)
    run.train(stop=True)
    run.close()
    train.main(make_args(out, logger="wandb", resume=True))
    first, second = loggers
    assert first.is_closed and second.is_closed
    assert first.values
    assert first.values + second.values == read_curve(out)
    assert first.options["id"] == second.options["id"]
    assert second.options["config"]["total_steps"] == "100"


def test_a_missing_library_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(logger_module, "find_spec", lambda name: None)
    message = r"tensorboard is not installed: pip install -e '.*\[tensorboard\]'"
    with pytest.raises(SystemExit, match=message):
        train.main(make_args(tmp_path / "run", logger="tensorboard"))
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_tensorboard_reads_the_log(tmp_path):
    reader = pytest.importorskip(
        "tensorboard.backend.event_processing.event_accumulator",
        reason="needs the extra tensorboard",
    )
    out = tmp_path / "run"
    train.main(make_args(out, logger="tensorboard"))
    log = reader.EventAccumulator(str(out / "tensorboard")).Reload()
    assert [event.step for event in log.Scalars("success")] == [0, 100]
