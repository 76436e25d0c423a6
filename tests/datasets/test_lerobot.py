"""LeRobot data sets: its package reads them back, pictures too."""

import pytest
import torch

import torch_panda
from tests.datasets.recording import record
from torch_panda import datasets
from torch_panda.commands import record as record_data
from torch_panda.datasets import generation
from torch_panda.datasets.demonstrations import read_demos

lerobot_dataset = pytest.importorskip(
    "lerobot.datasets.lerobot_dataset",
    reason="needs the extra lerobot, which takes an environment of its own",
)
EPISODES = 16


def test_a_lerobot_data_set_is_read_back(tmp_path):
    folder = tmp_path / "reach"
    record("lerobot", folder, "PandaReach-v1", EPISODES, image_size=96)
    dataset = lerobot_dataset.LeRobotDataset("torch_panda/reach", root=folder)
    assert len(dataset) == EPISODES * 50
    assert dataset.meta.total_episodes == EPISODES
    assert (dataset.meta.robot_type, dataset.fps) == ("panda", 25)
    seed = 3
    with torch_panda.make("PandaReach-v1", seed=seed) as env:
        start = env.reset()
        picture = env.render(size=96)
    first = dataset[seed * 50]
    assert first["seed"].item() == seed
    assert torch.equal(first["observation.state"], start["observation"])
    goals = torch.cat((start["achieved_goal"], start["desired_goal"]))
    assert torch.equal(first["observation.environment_state"], goals)
    seen = 255 * first["observation.images.scene"].permute(1, 2, 0)
    assert (seen - picture.float()).abs().mean() < 3  # a video is not exact
    with torch_panda.make("PandaReach-v1") as env:
        assert len(read_demos(folder, env)) == EPISODES * 49
    with pytest.raises(SystemExit, match="already"):
        record("lerobot", folder, "PandaReach-v1", 1)


def test_play_keeps_the_goal_of_each_step(tmp_path, monkeypatch):
    monkeypatch.setattr(generation, "PLAY_STEPS", 120)
    folder, recipe = tmp_path / "reach", {"kind": "play", "transitions": 240, "seed": 3}
    record_data.main(
        record_data.Args(
            "PandaReach-v1", format="lerobot", out=folder, image_size=64, **recipe
        )
    )
    expected = datasets.generate("PandaReach-v1", num_envs=2, **recipe)[:, :-1]
    with torch_panda.make("PandaReach-v1") as env:
        demos = read_demos(folder, env)
    for key in ("observation", "desired_goal", "action"):
        assert torch.equal(demos[key], expected[key].flatten(0, 1))
    for key in ("observation", "desired_goal", "reward"):
        assert torch.equal(demos["next", key], expected["next", key].flatten(0, 1))
