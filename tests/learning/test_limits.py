"""Limits of the commands' options, which are checked before a run starts."""

import importlib
import re
from dataclasses import fields
from functools import partial
from math import inf, nan
from typing import get_args, get_type_hints

import pytest

from torch_panda.commands import train, watch
from torch_panda.learning.agents import find_agent
from torch_panda.learning.limits import check_limits, find_limits
from torch_panda.learning.options import Args, check
from torch_panda.learning.training import Run


def numbers(hint):
    """Whether a type contains numbers."""
    parts = get_args(hint)
    return any(map(numbers, parts)) if parts else hint in (int, float)


@pytest.mark.parametrize(
    "script", ["train", "evaluate", "record", "watch", "bench", "distributed"]
)
def test_every_number_has_a_limit(script):
    if script == "distributed":
        pytest.importorskip("ray")
    options = importlib.import_module(f"torch_panda.commands.{script}").Args
    hints = get_type_hints(options, include_extras=True)
    names = [option.name for option in fields(options) if numbers(hints[option.name])]
    assert len(names) > 1
    assert not [name for name in names if not list(find_limits(hints[name]))]


def refused(script, message, **options):
    """The command ends with one line that matches the message."""
    with pytest.raises(SystemExit, match=f"^{message}$") as stop:
        script.main(script.Args(**options))
    assert "\n" not in str(stop.value)


@pytest.mark.parametrize(
    ("option", "value"),
    [
        *(("seed", -1), ("seed", 2**64), ("num_envs", 0), ("total_steps", -1)),
        *(("updates_per_step", -0.5), ("updates_per_step", inf), ("randomize", 0.5)),
        *(("desired_ratio", -0.1), ("desired_ratio", 1.1), ("desired_ratio", nan)),
        *(("random_eps", (0.0, nan)), ("gamma", 0.0), ("gamma", 1.01)),
    ],
)
def test_training_refuses_numbers_out_of_range(tmp_path, option, value):
    hints = get_type_hints(train.Args, include_extras=True)
    limit, *_ = find_limits(hints[option])
    message = re.escape(f"{option} must be {limit.description}, got {value}")
    out = tmp_path / "run"
    refused(train, message, **{option: value}, out=out)
    assert not out.exists()


@pytest.mark.parametrize(
    ("option", "value"),
    [
        *(("network", "layernorm"), ("augmentation", "mirror_shift"), ("algo", "ppo")),
        *(("exploration", "point"), ("her", "relabelled"), ("critics", "part")),
        *(("preset", "recipes"), ("logger", None)),
    ],
)
def test_training_refuses_unknown_choices(tmp_path, option, value):
    args = Args(**{option: value})
    for start in (check, partial(Run, out=tmp_path)):
        with pytest.raises(ValueError, match=f"^{option} must be one of .*{value}"):
            start(args)


def test_an_unknown_algorithm_is_not_taken_for_an_offline_one():
    with pytest.raises(ValueError, match=r"algo must be one of .*, got 'ppo'"):
        find_agent(Args(algo="ppo"))


@pytest.mark.parametrize("device", ["", "nothing", "meta", "cuda:99"])
def test_devices_that_do_not_work_are_refused(tmp_path, device):
    message = f"device must be one that torch can use here, .* got '{device}': .+"
    refused(train, message, device=device, out=tmp_path / "run")


def test_the_ends_of_ranges_are_accepted():
    lowest = {"seed": 0, "desired_ratio": 0.0, "random_eps": (0.0, 0.0)}
    check_limits(train.Args(**lowest, updates_per_step=0.0, total_steps=0))
    highest = {"seed": 2**64 - 1, "desired_ratio": 1.0, "random_eps": (1.0, 1.0)}
    check_limits(train.Args(**highest, gamma=1.0))
    check_limits(train.Args(gamma=None))
    for port in (1, 65535):
        check_limits(watch.Args(port=port))
