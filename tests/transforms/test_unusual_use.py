"""Hindsight in ways of use that were once silently wrong."""

import time

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer
from torchrl.envs import CatTensors, Compose, RewardScaling

from torch_panda.transforms import HindsightAugment, HindsightRelabel

BOTH = pytest.mark.parametrize("hindsight", [HindsightRelabel, HindsightAugment])
BUFFERS = pytest.mark.parametrize("buffer", [ReplayBuffer, TensorDictReplayBuffer])


def is_success(achieved, desired):
    return (achieved == desired).flatten(1).all(1, keepdim=True)


def compute_reward(achieved, desired):
    return is_success(achieved, desired).float() - 1


def episodes(number=6, steps=10, first=0):
    """Step t of episode e achieves 1000 e + t, and wants -1 - e: (number * steps,)."""
    episode = torch.arange(first, first + number).repeat_interleave(steps)
    step = torch.arange(steps).repeat(number)
    achieved = (1000 * episode + step)[:, None].float()
    desired = (-1 - episode)[:, None].float()
    done = (step == steps - 1)[:, None]
    following = {
        "achieved_goal": achieved + 1,
        "desired_goal": desired.clone(),
        "reward": -torch.ones(len(episode), 1),
        "success": torch.zeros_like(done),
        "terminated": torch.zeros_like(done),
        "truncated": done.clone(),
        "done": done,
    }
    td = {
        "observation": torch.rand(len(episode), 4),
        "achieved_goal": achieved,
        "desired_goal": desired,
        "collector": {"traj_ids": episode},
        "next": following,
    }
    return TensorDict(td, [len(episode)])


def make_buffer(transform, size=10_000, buffer=TensorDictReplayBuffer, **options):
    options = {"batch_size": 256, **options}
    storage = LazyTensorStorage(size)
    return buffer(storage=storage, transform=transform, **options)


def test_lazy_stacks_are_augmented():
    """Collectors that write into a buffer extend it with these."""
    rb = make_buffer(HindsightAugment(compute_reward, success_fn=is_success, k=4))
    rb.extend(TensorDict.lazy_stack(list(episodes().unbind(0))))
    stored = rb.storage[:]
    goals, achieved = stored["desired_goal"], stored["next", "achieved_goal"]
    assert int((goals >= 0).sum()) == 4 * 60
    assert torch.equal(stored["next", "success"], is_success(achieved, goals))


@BOTH
def test_a_step_of_many_environments_is_not_one_item(hindsight):
    rb = make_buffer(hindsight(compute_reward))
    with pytest.raises((RuntimeError, ValueError), match="extend"):
        rb.add(episodes().reshape(6, 10)[:, 0])


@BUFFERS
def test_an_episode_and_its_copies_are_not_one_item(buffer):
    rb = make_buffer(HindsightAugment(compute_reward), buffer=buffer)
    with pytest.raises(ValueError, match="extend"):
        rb.add(episodes(1, 1)[0])


@pytest.mark.parametrize(
    "first",
    [
        CatTensors(["observation", "desired_goal"], "policy_input", del_keys=False),
        RewardScaling(0.0, 0.1, in_keys=[("next", "reward")]),
    ],
    ids=["copy", "reward"],
)
def test_transforms_before_it_are_noticed_late(first):
    rb = make_buffer(Compose(first, HindsightRelabel(compute_reward)))
    for k in range(12):
        rb.extend(episodes(first=6 * k))
    with pytest.raises(ValueError, match="after this transform"):
        rb.sample()


def test_done_says_what_was_truncated():
    """torchrl's trainers set truncated on every row."""
    functions = {"success_fn": is_success, "terminated_fn": is_success}
    rb = make_buffer(HindsightRelabel(compute_reward, **functions))
    data = episodes()
    data["next", "truncated"].fill_(True)
    rb.extend(data)
    batch = rb.sample()
    stored = rb.storage[:]["next", "done"][batch["index"]]
    assert torch.equal(batch["next", "done"], stored | batch["next", "terminated"])
    assert batch["next", "terminated"].any()


class SlowStorage(LazyTensorStorage):
    def set(self, *args, **kwargs):
        time.sleep(0.05)
        return super().set(*args, **kwargs)


@pytest.mark.parametrize("strategy", ["episode", "random"])
def test_nothing_is_forgotten_while_it_is_written(strategy):
    rb = TensorDictReplayBuffer(
        storage=SlowStorage(100_000),
        transform=HindsightRelabel(compute_reward, strategy=strategy, her_ratio=1.0),
        batch_size=64,
        prefetch=3,
    )
    rb.extend(episodes(10))
    for k in range(5):
        rb.sample()
        rb.extend(episodes(100, first=10 + 100 * k))
    assert (rb[:]["desired_goal"] >= 0).all()


@pytest.mark.parametrize("achieved_type", [torch.int64, torch.float32])
def test_desired_goals_keep_their_precision(achieved_type):
    data = episodes()
    for key in ("achieved_goal", ("next", "achieved_goal")):
        data[key] = data[key].to(achieved_type)
    for key in ("desired_goal", ("next", "desired_goal")):
        data[key] = data[key].double() / 10
    rb = make_buffer(
        HindsightRelabel(
            lambda a, d: -(a.double() - d).abs().float(), strategy="desired"
        )
    )
    data["next", "reward"] = -(data["next", "achieved_goal"] - data["desired_goal"])
    data["next", "reward"] = data["next", "reward"].abs().neg().float()
    rb.extend(data)
    assert torch.isin(rb.sample()["desired_goal"], data["desired_goal"]).all()


@BOTH
def test_a_learned_reward_gets_no_gradient(hindsight):
    network = torch.nn.Linear(2, 1)
    scale = torch.ones(1, requires_grad=True)
    rb = make_buffer(hindsight(lambda a, d: network(torch.cat((a, d), -1))))
    with pytest.warns(UserWarning, match="other rewards"):
        rb.extend(episodes())
    for _ in range(2):
        (scale - rb.sample()["next", "reward"]).square().mean().backward()
    assert network.weight.grad is None


def test_parts_are_of_vectors():
    data = episodes()
    for key in ("achieved_goal", "desired_goal"):
        for place in (key, ("next", key)):
            data[place] = data[place][:, :, None].expand(-1, 3, 2).clone()
    rb = make_buffer(HindsightRelabel(compute_reward, goal_parts=(1, 1)))
    with pytest.raises(ValueError, match="the size of the goal vector"):
        rb.extend(data)
