"""The window of pybullet's GUI, replaced by a client without a window."""

import os

import numpy as np
import pytest

import torch_panda
from torch_panda import BulletError
from torch_panda.bullet import capi
from torch_panda.rendering import window
from torch_panda.rendering.camera import Camera


@pytest.fixture
def env():
    with torch_panda.make("PandaDrawer-v1", num_envs=2, seed=0) as env:
        env.reset()
        yield env


def test_the_window_shows_the_chosen_environment(env, monkeypatch):
    monkeypatch.setattr(window, "_check_display", lambda: None)
    monkeypatch.setattr(capi, "connect_window", lambda *_: capi.connect_direct())
    env.rollout(3)
    camera, pictures = Camera(width=60, height=40), []
    with env.open_window() as opened:
        for index in (0, 1, 1):
            opened.show(index)
            pictures.append(opened._client.render(camera).rgb.copy())
    assert (pictures[0] != pictures[1]).any()
    np.testing.assert_array_equal(pictures[1], pictures[2])
    with pytest.raises(BulletError, match="closed"):
        opened.show(0)


def test_a_window_that_cannot_be_created_raises(env, monkeypatch):
    monkeypatch.setattr(window, "_check_display", lambda: None)
    monkeypatch.setattr(capi, "connect_window", lambda *_: None)
    with pytest.raises(BulletError, match="could not create a client"):
        env.open_window()


@pytest.mark.skipif("DISPLAY" in os.environ, reason="there may be a display")
def test_without_a_display_the_error_names_the_viewer(env):
    with pytest.raises(BulletError, match=r"needs a display .*env\.open_viewer\(\)"):
        env.open_window()
