"""`GoalSampler` writes goals where their strategies say, and the first key's reward."""

import pytest
import torch
from torchrl.data import (
    LazyTensorStorage,
    SliceSampler,
)

from tests.devices import DEVICES
from tests.transforms.identifiable import (
    Envs,
    check_counts,
    check_goals,
    name_goals,
    reward_fn,
    terminated_fn,
)
from tests.transforms.pipelines import buffer
from torch_panda.transforms import GoalSampler, HindsightRelabel
from torch_panda.transforms.strategies import NAMES

ALL = {f"{name}_goal": name for name in NAMES}


def check_sample(batch, stored):
    """Asserts that every key of a batch by `ALL` is right."""
    batch, achieved = batch.reshape(-1), batch["next", "achieved_goal"].reshape(-1, 3)
    for key, strategy in ALL.items():
        assert torch.equal(batch[key], batch["next", key])
        check_goals(batch[key], achieved, stored, strategy)
    first = batch[next(iter(ALL))]
    assert torch.equal(batch["next", "reward"], reward_fn(achieved, first))


@pytest.mark.parametrize("device", DEVICES)
def test_goals_are_drawn_on_the_device_of_the_storage(device):
    storage = LazyTensorStorage(60, device=device)
    rb = buffer(GoalSampler(ALL, reward_fn), storage=storage)
    envs = Envs(3, [5, 9])
    for _ in range(3):
        rb.extend(name_goals(envs.chunk(10)).reshape(-1))
        batch = rb.sample()
        assert batch["future_goal"].device.type == device
        check_sample(batch.cpu(), rb.storage[:].cpu())


def test_the_first_key_determines_reward_success_and_ends():
    strategies = {"value_goal": {"current": 1, "random": 1}, "actor_goal": "random"}
    options = {"success_fn": terminated_fn, "terminated_fn": terminated_fn}
    rb = buffer(GoalSampler(strategies, reward_fn, seed=0, **options))
    data = name_goals(Envs(3, [4, 9]).chunk(20)).reshape(-1)
    data["next", "success"] = torch.zeros_like(data["next", "done"])
    rb.extend(data)
    batch, stored = rb.sample(), rb.storage[:]
    after, index = batch["next"], batch["index"]
    reached = terminated_fn(after["achieved_goal"], batch["value_goal"])
    assert 0.3 < reached.float().mean() < 0.8
    assert torch.equal(after["reward"], reached.float() - 1)
    assert torch.equal(after["success"], reached)
    assert torch.equal(after["terminated"], reached)
    truncated = stored["next", "truncated"][index]
    assert torch.equal(after["done"], reached | truncated)
    assert (batch["actor_goal"] != batch["value_goal"]).any()
    for place, name in ((batch, "desired_goal"), (after, "desired_goal")):
        assert torch.equal(place[name], stored["desired_goal"][index])


def test_the_desired_goal_may_be_a_key():
    rb = buffer(GoalSampler({"desired_goal": "final"}, reward_fn))
    rb.extend(name_goals(Envs(3, [4, 9]).chunk(20)).reshape(-1))
    batch = rb.sample()
    goal, achieved = batch["desired_goal"], batch["next", "achieved_goal"]
    check_goals(goal, achieved, rb.storage[:], "final")
    assert torch.equal(batch["next", "reward"], reward_fn(achieved, goal))


def test_the_rows_of_the_goals_are_returned():
    """The data have one dimension, and nothing was overwritten."""
    strategies = {"value": {"random": 1, "future": 1}, ("to", "desired"): "desired"}
    rb = buffer(GoalSampler(strategies, reward_fn))
    rb.extend(name_goals(Envs(3, [4, 9]).chunk(20)).transpose(0, 1).reshape(-1))
    batch, stored = rb.sample(), rb.storage[:]
    achieved = stored["next", "achieved_goal"][batch["value_row"]]
    assert torch.equal(batch["value"], achieved)
    desired = stored["desired_goal"][batch["to", "desired_row"]]
    assert torch.equal(batch["to", "desired"], desired)


def test_keys_draw_independently():
    rb = buffer(GoalSampler({"a": "random", "b": "random"}, reward_fn, seed=0))
    rb.extend(name_goals(Envs(10, [10]).chunk(10)).reshape(-1))
    batch = rb.sample(5000)
    assert (batch["a"] == batch["b"]).all(1).float().mean() < 0.03  # 1 in 100


def test_slices_share_the_goal_of_each_key():
    sampler = SliceSampler(slice_len=4, traj_key=("collector", "traj_ids"))
    rb = buffer(GoalSampler(ALL, reward_fn, unit="slice"), sampler=sampler)
    # Slices of 4 start at steps 0 to 2 and end at steps 3 to 5 of 6, so no slice begins
    # where another one ends, which would join both.
    rb.extend(name_goals(Envs(4, [6]).chunk(32)).reshape(-1))
    slices = rb.sample().reshape(-1, 4)
    for key in ALL:
        expected = slices["next", "achieved_goal"][:, -1:] if key[:3] == "cur" else None
        expected = slices[key][:, :1] if expected is None else expected
        assert (slices[key] == expected).all()


@pytest.mark.parametrize("capacity", [20, 20.0])
def test_rows_that_were_overwritten_get_their_own_goal(capacity):
    transform = GoalSampler(ALL, reward_fn, capacity=capacity)
    data = transform.inv(name_goals(Envs(2, [10]).chunk(20)).reshape(-1))
    batch = transform(data)
    old = data["hindsight_serial"] < 20
    for key in ALL:
        assert torch.equal(batch[key][old], data["next", "achieved_goal"][old])
        assert key == "current_goal" or (batch[key] != batch["current_goal"]).any()


@pytest.mark.parametrize("key", ["action", "reward", ("collector", "traj_ids")])
def test_entries_of_the_data_are_not_replaced(key):
    rb = buffer(GoalSampler({key: "future"}, reward_fn))
    with pytest.raises(ValueError, match=r"must not replace .* which the data have"):
        rb.extend(Envs(2, [4]).chunk(8).reshape(-1))


def test_the_representation_names_the_strategies():
    transform = GoalSampler({"goal": "future"}, reward_fn)
    assert repr(transform) == (
        "GoalSampler(strategies={'goal': 'future'}, discount=0.99, unit='row')"
    )


# -- the distribution of goals, in all transforms -------------------------------------

LENGTH = 8
ALL_TRANSFORMS = pytest.mark.parametrize("hindsight", [HindsightRelabel, GoalSampler])


def draw(hindsight, strategy, discount, n=4000):
    """Returns steps and goal steps of n or more rows, of finished episodes."""
    data = name_goals(Envs(5, [LENGTH]).chunk(LENGTH)).reshape(-1)
    options = {"discount": discount, "seed": 0}
    if hindsight is GoalSampler:
        transform = GoalSampler({"goal": strategy}, reward_fn, **options)
    else:
        options |= {"strategy": strategy, "her_ratio": 1}
        transform = hindsight(reward_fn, **options)
    rb = buffer(transform, batch_size=n)
    rb.extend(data)
    torch.manual_seed(0)
    batch = rb.sample()
    goal = batch["goal" if hindsight is GoalSampler else "desired_goal"]
    achieved = batch["next", "achieved_goal"]
    assert torch.equal(goal[:, :2], achieved[:, :2])
    return achieved[:, 2].long(), goal[:, 2].long()


@ALL_TRANSFORMS
@pytest.mark.parametrize(
    ("strategy", "discount"),
    [
        *(("geometric", discount) for discount in (0.5, 0.9, 0.99, 1.0)),
        *(("future", 0.5), ("episode", 0.5)),
    ],
)
def test_goals_have_the_distribution_of_their_strategy(hindsight, strategy, discount):
    steps, goal_steps = draw(hindsight, strategy, discount)
    counts, expected = [], []
    for step in range(1, LENGTH + 1):
        first = 1 if strategy == "episode" else step
        drawn = goal_steps[steps == step]
        counts.append(torch.bincount(drawn - first, minlength=LENGTH + 1 - first))
        base = discount if strategy == "geometric" else 1.0
        weights = base ** torch.arange(LENGTH + 1.0 - first)
        expected.append(len(drawn) * weights / weights.sum())
    check_counts(torch.cat(counts), torch.cat(expected), groups=LENGTH)


@ALL_TRANSFORMS
def test_geometric_goals_without_future_are_the_current_ones(hindsight):
    steps, goal_steps = draw(hindsight, "geometric", 0.0)
    assert torch.equal(steps, goal_steps)
