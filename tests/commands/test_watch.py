"""Watching a policy as a video and in a window."""

import os
import shutil
import subprocess
import sys
import time
from contextlib import nullcontext
from unittest.mock import Mock

import imageio.v3 as iio
import numpy as np
import pytest

import torch_panda
from torch_panda.commands import watch
from torch_panda.experts import make_expert
from torch_panda.learning.evaluation import video


@pytest.mark.parametrize("policy", ["random", "expert"])
def test_a_video_shows_every_step(tmp_path, monkeypatch, policy):
    monkeypatch.setattr(video, "CELL", (60, 80))
    out = tmp_path / "watch.gif"
    watch.main(watch.Args(policy=policy, env_id="PandaReach-v1", num_envs=2, out=out))
    frames = iio.imread(out)
    assert frames.shape == (51, 60, 160, 3)
    moved = np.abs(np.diff(frames.astype(int), axis=0)).max((1, 2, 3))
    assert (moved[:10] > 100).all()
    # The border of a solved cell is green.
    borders = frames[-1, 30, [1, 81]].astype(int)
    solved = borders[:, 1] > borders[:, 0] + 50
    assert solved.all() == (policy == "expert")


@pytest.fixture
def screen(tmp_path):
    """A virtual display: its name, and what it shows as (height, width, 4) bytes."""
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", "1", "-screen", "0", "1024x768x24", "-fbdir", tmp_path],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    number = server.stdout.readline().strip()

    def look():
        # An XWD file: sizes of 4 bytes, big-endian, then colours, then the picture.
        data = (tmp_path / "Xvfb_screen0").read_bytes()
        size = 4 * 1024 * 768
        return np.frombuffer(data[-size:], np.uint8).reshape(768, 1024, 4)

    yield f":{number}", look
    server.terminate()
    server.wait()


@pytest.mark.skipif(shutil.which("Xvfb") is None, reason="needs Xvfb")
def test_the_window_shows_the_arm_move(screen):
    display, look = screen
    process = subprocess.Popen(
        [sys.executable, "-m", "torch_panda", "watch", "--human", "--num-envs=2"],
        env={**os.environ, "DISPLAY": display},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    views = []
    while process.poll() is None:
        view = look()
        # The background has one colour, the scene in light and shade has many.
        if len(np.unique(view.view(np.uint32))) > 50:
            views.append(view.astype(int))
        time.sleep(0.1)
    output = process.communicate()[0]
    assert process.returncode == 0, output
    assert "episode 2 of 2: success" in output
    assert len(views) > 2
    assert any(np.abs(view - views[0]).max() > 50 for view in views[1:])


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="DISPLAY is of X11")
def test_a_window_without_a_display_ends_with_one_line(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(SystemExit, match="needs a display with OpenGL") as stop:
        watch.main(watch.Args(human=True, num_envs=1))
    assert "\n" not in str(stop.value)


def test_an_episode_that_ends_at_success_is_shown_as_one(monkeypatch, capsys):
    window = Mock()
    monkeypatch.setattr(torch_panda.RobotTaskEnv, "render_fps", 1e9)
    with torch_panda.make("PandaReach-v3", num_envs=1, seed=0) as env:
        monkeypatch.setattr(env, "open_window", lambda: nullcontext(window))
        watch.show(env, make_expert("PandaReach-v3"), episodes=2)
    assert capsys.readouterr().out.splitlines() == [
        "episode 1 of 2: success",
        "episode 2 of 2: success",
    ]
    assert 2 < window.show.call_count < 50  # the ends of both episodes are shown
