"""Mixtures of strategies and goals of several parts, on data that tell their origin."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.transforms.identifiable import Envs, check_share, name_goals, reward_fn
from tests.transforms.pipelines import PHASES, buffer
from torch_panda.transforms import HindsightRelabel
from torch_panda.transforms.strategies import NAMES

SAMPLE = 4000


def sample(capacity, lengths, **options):
    """Returns a sample, the desired goals as stored, and all that is stored."""
    torch.manual_seed(0)
    rb = buffer(
        HindsightRelabel(reward_fn, seed=0, **options),
        capacity=capacity,
        batch_size=SAMPLE,
    )
    envs = Envs(4, lengths)
    for _ in range(30):
        rb.extend(name_goals(envs.chunk(5)).reshape(-1))
    batch, stored = rb.sample(), rb.storage[:]
    return batch, stored["desired_goal"][batch["index"]], stored


def is_among(goals, others):
    """Which goals, (n, 3), are among others, (m, 3)."""
    return (goals[:, None] == others).all(-1).any(1)


mixtures = st.dictionaries(
    st.sampled_from(NAMES), st.floats(0.1, 10), min_size=1, max_size=len(NAMES)
)
layouts = {
    "capacity": st.integers(50, 400),
    "lengths": st.lists(st.integers(2, 30), min_size=1, max_size=3),
    "her_ratio": st.floats(0, 1),
}


@settings(max_examples=40, deadline=None, phases=PHASES)
@given(weights=mixtures, **layouts)
def test_mixtures_draw_allowed_goals_in_their_proportions(
    weights, capacity, lengths, her_ratio
):
    batch, own, stored = sample(
        capacity, lengths, her_ratio=her_ratio, strategy=weights
    )
    goal, achieved = batch["desired_goal"], batch["next", "achieved_goal"]
    assert (batch["next", "desired_goal"] == goal).all()
    assert (batch["next", "reward"] == reward_fn(achieved, goal)).all()
    is_achieved = goal[:, 2] > 0
    held = stored["next", "achieved_goal"]
    assert is_among(goal[is_achieved], held).all()
    assert is_among(goal[~is_achieved], stored["desired_goal"]).all()
    total = sum(weights.values())
    check_share(is_achieved, her_ratio * (1 - weights.get("desired", 0) / total))
    if "desired" not in weights:
        assert (goal == own)[~is_achieved].all()
    if "random" not in weights:
        of_own = (goal[:, :2] == achieved[:, :2]).all(1)
        assert of_own[is_achieved].all()
        if "episode" not in weights:
            assert (goal[:, 2] >= achieved[:, 2])[is_achieved].all()


@settings(max_examples=40, deadline=None, phases=PHASES)
@given(
    parts=st.sampled_from([(3,), (1, 2), (2, 1), (1, 1, 1)]),
    strategy=st.sampled_from(["future", "final", "episode"]),
    **layouts,
)
def test_parts_are_kept_or_achieved_at_allowed_steps(
    parts, strategy, capacity, lengths, her_ratio
):
    batch, own, stored = sample(
        capacity, lengths, her_ratio=her_ratio, strategy=strategy, goal_parts=parts
    )
    goal, achieved = batch["desired_goal"], batch["next", "achieved_goal"]
    assert (batch["next", "reward"] == reward_fn(achieved, goal)).all()
    masks = []
    for part in torch.arange(3).split(parts):
        is_new = (goal[:, part] != own[:, part]).all(1)
        assert (goal[:, part] == own[:, part])[~is_new].all()
        check_share(is_new, her_ratio)
        masks.append(is_new)
    for column in (0, 1):  # of the same environment and episode
        new = goal[:, column] != own[:, column]
        assert (goal[:, column] == achieved[:, column])[new].all()
    new = masks[-1]
    step, own_step = goal[new, 2], achieved[new, 2]
    held = stored["next", "achieved_goal"]
    source = torch.cat([achieved[new, :2], step[:, None]], 1)
    assert is_among(source, held).all()
    if strategy != "episode":
        assert (step >= own_step).all()
    if strategy == "final":
        source[:, 2] += 1
        assert not is_among(source, held).any()
    if len(masks) > 1:  # independently
        check_share(masks[0] & masks[1], her_ratio**2)


def test_a_mixture_may_hold_a_users_own_strategy():
    def own_step(step, first, end, generator):
        return step

    batch, _, _ = sample(200, [9], strategy={own_step: 1, "desired": 1})
    goal, achieved = batch["desired_goal"], batch["next", "achieved_goal"]
    is_achieved = goal[:, 2] > 0
    assert (goal == achieved)[is_achieved].all()
    check_share(is_achieved, 0.4)


@pytest.mark.parametrize("key", ["desired_goal", ("next", "achieved_goal")])
def test_goals_of_bfloat16_are_refused(key):
    data = name_goals(Envs(2, [5]).chunk(5)).reshape(-1)
    data[key] = data[key].bfloat16()
    rb = buffer(HindsightRelabel(reward_fn), capacity=99)
    with pytest.raises(ValueError, match=r"bfloat16.*float32"):
        rb.extend(data)
