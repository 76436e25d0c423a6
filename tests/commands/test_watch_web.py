"""Watching in a browser: the page follows the episodes, and a run as it is trained."""

import itertools
import os

import pytest
import torch

import torch_panda
from torch_panda.commands import watch
from torch_panda.learning.agents import Hyperparameters, make_agent
from torch_panda.learning.files.policy_files import save_policy


@pytest.mark.slow
def test_every_step_is_shown_on_the_page(monkeypatch):
    pytest.importorskip("yourdfpy", reason="needs the extra viewer")
    from torch_panda.rendering.web_viewer import WebViewer

    monkeypatch.setattr(torch_panda.RobotTaskEnv, "render_fps", 1e6)
    shown = []
    monkeypatch.setattr(WebViewer, "update", lambda self: shown.append(self.url))
    monkeypatch.setattr(itertools, "repeat", lambda policy: iter([policy] * 2))
    watch.main(watch.Args(env_id="PandaReach-v1", num_envs=2, web=True, port=8765))
    assert len(shown) == 2 * 51


def test_a_run_is_read_again_when_it_is_saved(tmp_path):
    with torch_panda.make("PandaReach-v1", num_envs=1) as env:

        def save(seed):
            torch.manual_seed(seed)
            agent = make_agent(env, Hyperparameters())
            save_policy(tmp_path / "checkpoint.pt", agent, "PandaReach-v1")
            os.utime(tmp_path / "checkpoint.pt", (seed, seed))

        save(1)
        policies = watch.follow(tmp_path)
        first = next(policies)
        assert next(policies) is first
        save(2)
        second = next(policies)
        start = env.reset()
        with torch.no_grad():
            actions = [policy(start.clone())["action"] for policy in (first, second)]
        assert not torch.equal(*actions)
