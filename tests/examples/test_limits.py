"""The numbers that the scripts accept: others are refused before a run starts."""

import importlib
import re
from dataclasses import fields
from math import inf, nan

import pytest

import evaluate
import record_demos
import train
import watch
from limits import LIMITS, check_limits

NUMBERS = (int, float, int | None, float | None)


@pytest.mark.parametrize(
    "script", ["train", "evaluate", "record_demos", "watch", "distributed"]
)
def test_every_number_has_a_limit(script):
    if script == "distributed":
        pytest.importorskip("ray")
    options = fields(importlib.import_module(script).Args)
    numbers = {option.name for option in options if option.type in NUMBERS}
    limited = [name for _, names in LIMITS.values() for name in names]
    assert len(numbers) > 1
    assert numbers <= set(limited)
    assert len(limited) == len(set(limited))


def refused(script, message, **options):
    """The script ends with one line, this one."""
    with pytest.raises(SystemExit, match=f"^{message}$") as stop:
        script.main(script.Args(**options))
    assert "\n" not in str(stop.value)


@pytest.mark.parametrize(
    ("option", "value"),
    [
        *(("seed", -1), ("seed", 2**64), ("total_steps", -1), ("eval_interval", 0)),
        *(("save_interval", 0), ("eval_episodes", 0), ("num_envs", 0)),
        *(("num_threads", 0), ("torch_threads", 0), ("batch_size", 0)),
        *(("buffer_size", 0), ("hidden_size", 0), ("learning_rate", 0.0)),
        *(("learning_rate", inf), ("alpha", 0.0), ("updates_per_step", -0.5)),
        *(("updates_per_step", inf), ("action_l2", nan), ("bc_weight", -1.0)),
        *(("noise_eps", -0.1), ("policy_noise", -0.1), ("shift", -0.1)),
        *(("fine_inputs", -0.01), ("demo_her_ratio", 1.5)),
        *(("pretrain_updates", -1), ("goal_height", inf)),
        *(("her_ratio", -0.1), ("her_ratio", 1.1), ("keep_unmoved", 2.0)),
        *(("random_eps", 1.5), ("max_random_eps", nan), ("demo_ratio", 1.0)),
        *(("gamma", 0.0), ("gamma", 1.01), ("tau", 0.0), ("tau", 1.5)),
        *(("drop_quantiles", 25), ("drop_quantiles", -1)),
    ],
)
def test_training_refuses(tmp_path, option, value):
    (accepted,) = [what for what, (_, names) in LIMITS.items() if option in names]
    message = re.escape(f"{option} must be {accepted}, got {value}")
    small = {"total_steps": 1, "eval_episodes": 1, "num_envs": 1, "video": False}
    out = tmp_path / "run"
    refused(train, message, **(small | {option: value}), out=out)
    assert not out.exists()


@pytest.mark.parametrize("her_ratio", [0.0, 1 / 3, 1.0])
def test_ratios_without_stored_copies(tmp_path, her_ratio):
    message = ".*her_ratio must be above 1/3 and below 1, got .*"
    options = {"her": "augment", "her_ratio": her_ratio, "total_steps": 1}
    refused(train, message, **options, out=tmp_path / "run")


def test_goals_without_height(tmp_path):
    out, message = tmp_path / "run", "goal_height is for goals that are positions"
    refused(train, message, env_id="PandaFlip-v1", goal_height=0.03, out=out)


@pytest.mark.parametrize("device", ["", "nothing", "meta", "cuda:99"])
def test_devices_that_do_not_work(tmp_path, device):
    message = f"device must be one that torch can use here, .* got '{device}': .+"
    refused(train, message, device=device, out=tmp_path / "run")


@pytest.mark.parametrize(
    ("script", "option", "value"),
    [
        *((evaluate, "episodes", 0), (evaluate, "num_envs", 0), (evaluate, "seed", -1)),
        *(
            (record_demos, "episodes", 0),
            (record_demos, "num_envs", 0),
            (record_demos, "seed", -1),
        ),
        *((watch, "num_envs", 0), (watch, "seed", 2**64)),
    ],
)
def test_others_refuse(tmp_path, script, option, value):
    (tmp_path / "checkpoint.pt").touch()
    options = {option: value} | ({"run": tmp_path} if script is evaluate else {})
    refused(script, f"{option} must be .*, got {value}", **options)


def test_accepts_presets_and_ends_of_ranges():
    for preset in train.PRESETS.values():
        check_limits(preset)
    lowest = {"seed": 0, "her_ratio": 0.0, "random_eps": 0.0, "demo_ratio": 0.0}
    check_limits(train.Args(**lowest, shift=0.0, updates_per_step=0.0, total_steps=1))
    highest = {"seed": 2**64 - 1, "her_ratio": 1.0, "gamma": 1.0, "tau": 1.0}
    check_limits(train.Args(**highest, keep_unmoved=1.0, drop_quantiles=24))
