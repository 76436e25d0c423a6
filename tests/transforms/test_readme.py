"""The README's pipelines without this package's environments, as they stand there."""

import re
from pathlib import Path

import panda_gym  # noqa: F401, registers PandaPush-v3
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import GymEnv

from torch_panda.transforms import HindsightAugment, HindsightRelabel


def reward(achieved_goal, desired_goal):
    return -((achieved_goal - desired_goal).norm(dim=-1, keepdim=True) > 0.05).float()


def test_relabel_with_gym_env():
    rb = TensorDictReplayBuffer(
        storage=LazyTensorStorage(1_000),
        batch_size=256,
        transform=HindsightRelabel(reward, her_ratio=0.8, strategy="future"),
    )
    for data in Collector(
        lambda: GymEnv("PandaPush-v3"), frames_per_batch=80, total_frames=240
    ):
        rb.extend(data)
        batch = rb.sample()
    stored = rb.storage[:][batch["index"]]
    changed = (batch["desired_goal"] != stored["desired_goal"]).any(-1)
    assert 0.65 < changed.float().mean() < 0.95
    expected = reward(batch["next", "achieved_goal"], batch["desired_goal"])
    assert (batch["next", "reward"] == expected).all()


def test_augment_of_random_walks():
    walk = torch.randn(64, 51, 2).cumsum(1)
    goal = torch.randn(64, 1, 2).expand(64, 50, 2)
    done = torch.arange(50).eq(49)[:, None].expand(64, 50, 1)
    rb = TensorDictReplayBuffer(
        storage=LazyTensorStorage(100_000),
        batch_size=256,
        transform=HindsightAugment(reward, k=4),
    )
    after = {"achieved_goal": walk[:, 1:], "desired_goal": goal, "done": done}
    after["reward"] = reward(walk[:, 1:], goal)
    before = {"achieved_goal": walk[:, :-1], "desired_goal": goal}
    rb.extend(TensorDict({**before, "next": after}, [64, 50]))
    batch = rb.sample()

    assert len(rb) == 64 * 50 * 5
    assert batch.shape == (256,)
    stored = rb.storage[:]
    reached = walk[:, 1:].reshape(-1, 2)
    copies = stored[64 * 50 :]
    assert torch.isin(copies["desired_goal"], reached).all()
    expected = reward(stored["next", "achieved_goal"], stored["desired_goal"])
    assert (stored["next", "reward"] == expected).all()
    assert (copies["next", "reward"] == 0).float().mean() > 1 / 50


GUIDE = Path(__file__).parents[2] / "transforms" / "README.md"


def test_guide():
    """Its snippets run one after the other, as a reader would type them."""
    text = GUIDE.read_text()
    snippets = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    names = {}
    for snippet in snippets:
        exec(compile(snippet, str(GUIDE), "exec"), names)
    assert len(snippets) == 6
    assert names["slices"].shape == (50, 5)
    goals = names["slices"]["desired_goal"]
    assert (goals == goals[:, :1]).all()
    assert names["batch"].shape == (256,)
