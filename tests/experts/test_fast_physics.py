"""Success of experts under coarser physics: run with pytest -m slow -s.

Under `physics="fast"` it must not fall by more than 2 percentage points in Reach, Push,
PickAndPlace and Stack. In Slide and Flip it falls further: an expected failure. If only
the solver stops earlier, Slide must not lose more than 5 points.
"""

import pytest
import torch

import torch_panda
from torch_panda import experts
from torch_panda.commands import record as record_demos

pytestmark = pytest.mark.slow


def success(task, physics, episodes):
    """Whether an expert succeeds at the end and at any time, (episodes, 2)."""
    env_id, flags = f"Panda{task}-v1", []
    expert = experts.make_expert(env_id)
    with torch_panda.make(env_id, num_envs=32, seed=7, physics=physics) as env:
        while len(flags) < episodes:
            for episode in record_demos.play(env, expert):
                reached = episode["next", "success"]
                flags.append((reached[-1].item(), reached.any().item()))
    return torch.tensor(flags).double()


# Slide and Flip are sensitive, so their rates need more episodes. Slide needs the exact
# 20 substeps.
STRIKES = pytest.mark.xfail(strict=True, reason="strikes need exact physics")
EARLY_END = {"residual_threshold": 1e-3}  # the solver stops early, all else is exact


@pytest.mark.timeout(1800)
@pytest.mark.parametrize(
    ("task", "physics", "episodes", "allowed"),
    [
        ("Reach", "fast", 256, 2),
        ("Push", "fast", 256, 2),
        ("PickAndPlace", "fast", 256, 2),
        ("Stack", "fast", 256, 2),
        pytest.param("Slide", "fast", 2048, 5, marks=STRIKES),
        pytest.param("Flip", "fast", 1024, 2, marks=STRIKES),
        ("Slide", EARLY_END, 2048, 5),
    ],
)
def test_experts_succeed_nearly_as_often_under_coarser_physics(
    task, physics, episodes, allowed
):
    """The success at the end falls by at most the allowed percentage points."""
    params = physics if physics == "fast" else torch_panda.PhysicsParams(**physics)
    exact, other = (success(task, p, episodes) for p in ("exact", params))
    change = 100 * (other - exact)  # paired: starts and goals are the same
    mean, error = change.mean(0), 1.96 * change.std(0) / episodes**0.5
    for k, when in enumerate(("at the end", "at any time")):
        print(
            f"{task}: {when} exact {100 * exact[:, k].mean():.1f} %, {physics} "
            f"{100 * other[:, k].mean():.1f} %, {mean[k]:+.1f} +- {error[k]:.1f}"
        )
    assert mean[0] + error[0] > -allowed
