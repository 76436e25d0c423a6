"""Fixed evaluation tasks."""

import pytest
import torch

import torch_panda
from tests.ids import PHYSICS_IDS
from torch_panda import evaluation_tasks
from torch_panda.learning.evaluation_tasks import QUANTILES


@pytest.mark.parametrize("env_id", PHYSICS_IDS[::4])
def test_an_environment_starts_from_each_task(env_id):
    tasks = evaluation_tasks(env_id)
    assert list(tasks) == list(QUANTILES)
    distances = []
    with torch_panda.make(env_id) as env:
        for state in tasks.values():
            start = env.reset(state, set_state=True)
            assert torch.equal(start["desired_goal"], state["desired_goal"].float())
            goals = start["achieved_goal"], start["desired_goal"]
            distances.append(float(env.task.distance(*goals)))
    assert distances == pytest.approx(sorted(distances), abs=1e-6)
    assert distances[0] < distances[-1]


def test_the_tasks_are_always_the_same():
    first, second = evaluation_tasks("PandaPush-v1"), evaluation_tasks("PandaPush-v1")
    assert all((first[name] == second[name]).all() for name in first)
