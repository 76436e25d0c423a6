"""Options that the transforms do not accept, with the error that each raises."""

import pytest

from tests.transforms.identifiable import reward_fn
from tests.transforms.pipelines import make as make_env
from torch_panda.transforms import GoalSampler, HindsightRelabel


def relabel(**options):
    return HindsightRelabel(**{"reward_fn": reward_fn, **options})


def from_env(**options):
    return HindsightRelabel.from_env(None, **options)


def sample(strategies=(("goal", "future"),), **options):
    if isinstance(strategies, tuple):
        strategies = dict(strategies)
    return GoalSampler(strategies, reward_fn, **options)


BAD_VALUES = [
    (relabel, {"reward_fn": None}, "reward_fn must be a function, got None"),
    (relabel, {"her_ratio": -1}, "her_ratio must be within"),
    (relabel, {"her_ratio": 2}, "her_ratio must be within"),
    (relabel, {"capacity": 0}, "capacity must be a positive integer"),
    (relabel, {"capacity": 1.5}, "capacity must be a positive integer"),
    (relabel, {"capacity": float("inf")}, "capacity must be a positive integer"),
    (relabel, {"goal_parts": ()}, "goal_parts must be positive sizes"),
    (relabel, {"goal_parts": (0, 3)}, "goal_parts must be positive sizes"),
    (relabel, {"unit": "episode"}, 'unit must be "row" or "slice"'),
    (relabel, {"strategy": "past"}, "strategy must be one of.*got 'past'"),
    (relabel, {"strategy": None}, "strategy must be one of.*got None"),
    (relabel, {"strategy": {"past": 1}}, "strategy must be one of.*got 'past'"),
    (relabel, {"strategy": {}}, "strategy must be one of"),
    (relabel, {"strategy": {"future": 0.0}}, "strategy must have positive, finite"),
    (relabel, {"strategy": {"future": 1e999}}, "strategy must have positive, finite"),
    (relabel, {"discount": -0.1}, "discount must be within"),
    (sample, {"strategies": {}}, "strategies must map keys"),
    (sample, {"strategies": "future"}, "strategies must map keys.*'future'"),
    (sample, {"strategies": {"goal": "past"}}, "strategy must be one of.*'past'"),
    (sample, {"strategies": {"achieved_goal": "future"}}, "must not replace 'achieved"),
]
UNKNOWN = [
    (from_env, {"k": 4}, "HindsightRelabel has no argument 'k'; use her_ratio=0.8; "),
    (from_env, {"n_sampled_goal": 1}, "use her_ratio=0.5; accepted are reward_fn"),
    (from_env, {"goal_selection_strategy": "final"}, "use strategy; accepted"),
    (from_env, {"stategy": "final"}, "accepted are .* strategy, .*goal_parts"),
    (relabel, {"stategy": "final"}, "unexpected keyword argument 'stategy'"),
    (sample, {"her_ratio": 0.8}, "unexpected keyword argument 'her_ratio'"),
]
CASES = [
    *((*case, ValueError) for case in BAD_VALUES),
    *((*case, TypeError) for case in UNKNOWN),
]


@pytest.mark.parametrize(("make", "options", "message", "error"), CASES)
def test_options_that_are_not_accepted_raise(make, options, message, error):
    with pytest.raises(error, match=message):
        make(**options)


def test_from_env_needs_the_strategies_of_a_goal_sampler():
    with pytest.raises(TypeError, match=r"missing .* argument: 'strategies'"):
        GoalSampler.from_env(make_env("PandaReach-v1"))
