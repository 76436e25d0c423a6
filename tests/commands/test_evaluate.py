"""The command `evaluate`: its options, and the report that it prints."""

import torch

from torch_panda.commands import evaluate
from torch_panda.learning.evaluation import Evaluation, wilson_interval


def make_evaluation(successes, ever, episodes):
    numbers = torch.arange(episodes)
    return Evaluation(
        success=numbers < successes,
        ever=numbers < ever,
        at_start=numbers < 1,
        returns=-numbers.float(),
        lengths=numbers + 1,
    )


def test_the_report_has_the_results_of_the_evaluation(monkeypatch, capsys):
    result = make_evaluation(10, 15, 20)
    calls = []
    monkeypatch.setattr(
        evaluate, "evaluate", lambda *args, **options: calls.append(options) or result
    )
    options = {"episodes": 20, "seed": 7, "num_envs": 5, "workers": 3, "tasks": "fixed"}
    options |= {"physics": "fast", "task_options": {"distance_threshold": 0.1}}
    evaluate.main(evaluate.Args("PandaReach-v1", **options))
    assert calls == [{**options, "num_threads": None}]
    low, high = (f"{end:.1%}" for end in wilson_interval(10, 20))
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == (
        "PandaReach-v1, distance_threshold 0.1, 20 episodes, fast physics"
    )
    assert [" ".join(line.split()) for line in lines[1:]] == [
        f"success at the end 50.0% [{low}, {high}]",
        "success at any time 75.0% [53.1%, 88.8%]",
        "solved at the start 5.0% [0.9%, 23.6%]",
        "return -9.50 [-12.09, -6.91]",
        "steps 10.5",
    ]


def test_published_numbers_have_the_default_seed_and_number_of_environments():
    args = evaluate.Args("PandaReach-v1")
    assert (args.seed, args.num_envs, args.physics) == (1_000, 32, "exact")
