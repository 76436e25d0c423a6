"""Buffers that are saved under one strategy and loaded under another."""

import pytest

from tests.transforms.identifiable import Envs, check_goals, name_goals, reward_fn
from tests.transforms.pipelines import buffer
from torch_panda.transforms import GoalSampler, HindsightRelabel

MIXTURE = {"future": 0.5, "desired": 0.5}


def make(transform, strategy):
    if transform is GoalSampler:
        return buffer(GoalSampler({"goal": strategy}, reward_fn))
    return buffer(HindsightRelabel(reward_fn, strategy=strategy, her_ratio=1.0))


def play(first=0):
    return name_goals(Envs(3, [5, 9], first_env=first).chunk(20)).reshape(-1)


def reload(rb, new, how, folder):
    if how == "dumps":
        rb.dumps(folder)
        new.loads(folder)
    else:
        new.extend(play(first=20))  # a storage is made lazily
        new.load_state_dict(rb.state_dict())


def check(rb, strategy):
    """Asserts that the drawn goals are where the strategy may draw them."""
    batch = rb.sample()
    goal = batch.get("goal", batch["desired_goal"])
    if strategy == MIXTURE:
        assert (goal[:, 2] < 0).any(), "no desired goal"
    else:
        check_goals(goal, batch["next", "achieved_goal"], rb.storage[:], strategy)


HOW = pytest.mark.parametrize("how", ["dumps", "state_dict"])
TRANSFORMS = pytest.mark.parametrize("transform", [HindsightRelabel, GoalSampler])


@HOW
@TRANSFORMS
@pytest.mark.parametrize(
    ("saved", "loaded"),
    [("desired", "future"), ("future", MIXTURE), ("final", "random")],
)
def test_another_strategy_draws_from_a_loaded_buffer(
    transform, saved, loaded, how, tmp_path
):
    rb, new = make(transform, saved), make(transform, loaded)
    rb.extend(play())
    reload(rb, new, how, tmp_path)
    check(new, loaded)
    new.extend(play(first=10))
    check(new, loaded)


def test_an_empty_buffer_is_loaded_under_any_strategy(tmp_path):
    rb, new = make(HindsightRelabel, "future"), make(HindsightRelabel, "desired")
    new.transform[0].set_extra_state(rb.transform[0].get_extra_state())
    new.extend(play())
    check(new, "desired")
