"""Folders of runs: killed runs can be resumed, and two runs do not share a folder."""

import multiprocessing
import os
import socket
import time
from dataclasses import replace
from functools import partial

import pytest
import torch

import torch_panda
from tests.commands.runs import Kill, kill, points, weights
from tests.learning.test_geometry import OneNumberMore
from torch_panda.commands import train
from torch_panda.learning.files import run_files
from torch_panda.learning.files.run_files import check_folder, lock_folder
from torch_panda.learning.options import Args
from torch_panda.learning.training import Run

pytestmark = pytest.mark.usefixtures("quick")


def train_whole(args, out):
    """Train until the end, and return the weights and the curve without times."""
    run = Run(args, out)
    run.train()
    run.close()
    return weights(run), points(run)


def test_a_run_killed_in_its_first_evaluation_can_be_resumed(tmp_path, monkeypatch):
    """Its curve.csv is there already."""
    args = Args(num_envs=2, total_steps=100, updates_per_step=0.1)
    whole = train_whole(args, tmp_path / "whole")
    out = tmp_path / "killed"
    out.mkdir()
    run = Run(args, out)
    with monkeypatch.context() as patch, pytest.raises(Kill):
        patch.setattr(run_files, "plot_curve", kill)
        run.train()
    run.close()
    assert (out / "curve.csv").exists()
    check_folder(out, resume=True)
    resumed = train_whole(replace(args, resume=True), out)
    torch.testing.assert_close(resumed, whole, rtol=0, atol=0)


def test_a_run_is_not_resumed_after_its_task_has_changed(tmp_path):
    robot = partial(torch_panda.Panda, block_gripper=True)
    args = Args(env_id="Changed-v0", num_envs=2, total_steps=100, updates_per_step=0.1)
    torch_panda.register("Changed-v0", robot=robot, task=torch_panda.Push)
    train_whole(args, tmp_path)
    torch_panda.register("Changed-v0", robot=robot, task=OneNumberMore)
    with pytest.raises(ValueError, match=r"cannot resume .* the task or the version"):
        Run(replace(args, resume=True), tmp_path)


def hold(folder, sender):
    with lock_folder(folder):
        sender.send("locked")
        time.sleep(100)


@pytest.fixture
def other_process(tmp_path):
    """A process that writes into the folder."""
    receiver, sender = multiprocessing.Pipe(duplex=False)
    fork = multiprocessing.get_context("fork")
    process = fork.Process(target=hold, args=(tmp_path, sender))
    process.start()
    assert receiver.poll(60)
    yield process
    process.kill()
    process.join()


@pytest.mark.parametrize("resume", [False, True])
def test_a_folder_that_another_process_uses_is_refused(tmp_path, other_process, resume):
    (tmp_path / "resume.pt").touch()
    name = f"process {other_process.pid} on {socket.gethostname()}"
    with pytest.raises(SystemExit, match=f"^{name} writes into {tmp_path}: stop that"):
        train.main(Args(out=tmp_path, resume=resume))


def test_the_lock_ends_with_its_process(tmp_path, other_process):
    other_process.kill()
    other_process.join()
    with lock_folder(tmp_path):
        text = (tmp_path / "process.txt").read_text()
        assert text == f"process {os.getpid()} on {socket.gethostname()}"
    assert not (tmp_path / "process.txt").exists()
    check_folder(tmp_path, resume=False)
