"""What is compared, and what is left out."""

from contextlib import closing

import pytest
import torch

from torch_panda.bench import comparison
from torch_panda.bench.contenders import CONTENDERS
from torch_panda.bench.processes import available_memory
from torch_panda.bench.runner import ContenderError
from torch_panda.bench.stepping import Setting

SETTING = Setting("PandaPush-v3", num_envs=2, num_threads=1)


def run(contenders):
    return comparison.compare(
        SETTING, contenders, rounds=1, steps=1, progress=lambda what: None
    )


def test_memory_is_read():
    assert 100 < available_memory() < 100_000_000  # [MB]


def test_what_does_not_fit_into_memory_is_left_out(monkeypatch):
    # Two environments of ours, and two of the fast ones, but not two processes.
    monkeypatch.setattr(comparison, "available_memory", lambda: 250.0)
    results, absences = run(["fast", "async"])
    assert [result.contender for result in results] == ["torch_panda", "fast"]
    assert [absence.contender for absence in absences] == ["async"]
    assert absences[0].reason == "2 environments need about 0.2 GB, 0.2 GB are free"


@pytest.mark.parametrize(("free", "most"), [(250.0, 2), (150.0, 1)])
def test_what_does_not_fit_at_once_is_made_anew_for_each_round(monkeypatch, free, most):
    """Two environments take 90 MB: of 150 MB, enough for one contender at a time."""
    living, largest = set(), 0

    class CountedRunner(comparison.Runner):
        def __init__(self, *args):
            nonlocal largest
            super().__init__(*args)
            living.add(self)
            largest = max(largest, len(living))

        def close(self):
            super().close()
            living.discard(self)

    monkeypatch.setattr(comparison, "available_memory", lambda: free)
    monkeypatch.setattr(comparison, "Runner", CountedRunner)
    results, absences = run(["fast"])
    assert not absences
    assert [result.contender for result in results] == ["torch_panda", "fast"]
    assert all(len(result.speeds) == len(result.ratios) == 1 for result in results)
    assert all(result.footprint.creation > 0 for result in results)
    assert largest == most


def test_our_own_must_fit(monkeypatch):
    monkeypatch.setattr(comparison, "available_memory", lambda: 80.0)
    with pytest.raises(ContenderError, match=r"2 environments need about 0\.1 GB, "):
        run([])


def test_bare_bullet_repeats_an_episode():
    """Its clients are torch_panda's own, and go through the same states each time."""
    setting = Setting("PandaPush-v3", num_envs=2, num_threads=2)
    with closing(CONTENDERS["bare-bullet"].make(setting)) as contender:
        state = contender._env.episodes.simulation.joint_position
        episodes = []
        for _ in range(2):
            positions = []
            for _ in range(50):
                contender.step()
                positions.append(state.clone())
            episodes.append(torch.stack(positions))
    first, second = episodes
    assert torch.equal(first, second)
    assert first.std(dim=0).max() > 0.01  # [rad]: it moves
