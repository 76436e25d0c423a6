"""Hindsight in ways of use that were once silently wrong."""

import time

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage
from torchrl.envs import Compose, RewardScaling

from tests.transforms.identifiable import Envs, name_goals, reward_fn, terminated_fn
from tests.transforms.pipelines import buffer
from torch_panda.transforms import HindsightRelabel


def play(number=6, first=0):
    """Episodes of 10 steps, flattened. No desired goal is reached."""
    data = name_goals(Envs(number, [10], first_env=first).chunk(10)).reshape(-1)
    data["next", "success"] = torch.zeros_like(data["next", "done"])
    return data


def test_lazy_stacks_are_relabelled():
    """Collectors that write into a buffer extend it with these."""
    rb = buffer(
        HindsightRelabel(reward_fn, success_fn=terminated_fn, her_ratio=1.0),
        capacity=60,
    )
    rb.extend(TensorDict.lazy_stack(list(play().unbind(0))))
    batch = rb.sample()
    goals, achieved = batch["desired_goal"], batch["next", "achieved_goal"]
    assert (goals[:, 2] > 0).all()
    assert torch.equal(batch["next", "success"], terminated_fn(achieved, goals))


def test_scaled_rewards_are_noticed_when_they_are_sampled():
    scaling = RewardScaling(0.0, 0.1, in_keys=[("next", "reward")])
    rb = buffer(Compose(scaling, HindsightRelabel(reward_fn)))
    for k in range(12):
        rb.extend(play(first=6 * k))
    with pytest.raises(ValueError, match="after this transform"):
        rb.sample()


def test_done_rather_than_truncated_marks_the_ends():
    """torchrl's trainers set truncated on every row."""
    rb = buffer(HindsightRelabel(reward_fn, terminated_fn=terminated_fn))
    data = play()
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
def test_no_row_is_forgotten_while_it_is_written(strategy):
    rb = buffer(
        HindsightRelabel(reward_fn, strategy=strategy, her_ratio=1.0),
        storage=SlowStorage(100_000),
        prefetch=3,
    )
    rb.extend(play(10))
    for k in range(5):
        rb.sample()
        rb.extend(play(100, first=10 + 100 * k))
    assert (rb[:]["desired_goal"][:, 2] > 0).all()


@pytest.mark.parametrize("achieved_type", [torch.int64, torch.float32])
def test_desired_goals_keep_their_precision(achieved_type):
    def distance_reward(achieved, desired):
        return -(achieved.double() - desired).norm(dim=-1, keepdim=True).float()

    data = play()
    for place in (data, data["next"]):
        place["achieved_goal"] = place["achieved_goal"].to(achieved_type)
        place["desired_goal"] = place["desired_goal"].double() / 10
    goals = data["next", "achieved_goal"], data["desired_goal"]
    data["next", "reward"] = distance_reward(*goals)
    rb = buffer(HindsightRelabel(distance_reward, strategy="desired"))
    rb.extend(data)
    batch = rb.sample()
    assert torch.isin(batch["desired_goal"], data["desired_goal"]).all()
    own = data["desired_goal"][batch["index"]]
    assert (batch["desired_goal"] != own).any()


def test_a_learned_reward_gets_no_gradient():
    network = torch.nn.Linear(6, 1)
    scale = torch.ones(1, requires_grad=True)
    rb = buffer(HindsightRelabel(lambda a, d: network(torch.cat((a, d), -1))))
    rb.extend(play())
    with pytest.warns(UserWarning, match="other rewards"):
        rb.sample()
    for _ in range(2):
        batch = rb.sample()
        assert (batch["desired_goal"][:, 2] > 0).any()
        (scale - batch["next", "reward"]).square().mean().backward()
    assert network.weight.grad is None
