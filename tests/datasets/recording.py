"""Records and generates small data sets."""

from pathlib import Path

import pytest

from torch_panda import datasets
from torch_panda.commands import record as record_demos
from torch_panda.datasets import generation

TRANSITIONS = 130


@pytest.fixture
def short_play(monkeypatch):
    monkeypatch.setattr(generation, "PLAY_STEPS", 120)


def generate(kind, *, env_id="PandaReach-v3", num_envs=3, **options):
    options = {"transitions": TRANSITIONS, "seed": 7, **options}
    return datasets.generate(env_id, kind=kind, num_envs=num_envs, **options)


def record(format, out, env_id, episodes, seed=0, **options):
    record_demos.main(
        record_demos.Args(
            env_id, episodes, seed, num_envs=8, format=format, out=Path(out), **options
        )
    )
