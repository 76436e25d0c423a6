"""Fixed evaluation tasks."""

from functools import partial

import pytest
import torch

import torch_panda
from tests.ids import PHYSICS_IDS
from torch_panda import evaluation_tasks
from torch_panda.learning.evaluation.fixed_tasks import _CHOSEN, QUANTILES


@pytest.mark.parametrize("env_id", PHYSICS_IDS[::8])
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


def test_the_tasks_are_quantiles_of_the_distances_of_random_starts():
    """The fixture `few_starts` lets 11 starts suffice."""
    names = ["very_near", "near", "medium", "far", "very_far"]
    with torch_panda.make("PandaReach-v1", num_envs=11, seed=0) as env:
        start = env.reset()
    offset = start["achieved_goal"] - start["desired_goal"]
    order = offset.norm(dim=1).argsort()
    expected = start["desired_goal"][order[[0, 2, 5, 8, 10]]]
    tasks = evaluation_tasks("PandaReach-v1")
    assert list(tasks) == names
    for name, goal in zip(names, expected, strict=True):
        assert torch.equal(tasks[name]["desired_goal"].float(), goal)


def test_the_tasks_are_always_the_same():
    first = evaluation_tasks("PandaPush-v1")
    _CHOSEN.clear()
    again = evaluation_tasks("PandaPush-v1")
    assert all((first[name] == again[name]).all() for name in first)


def test_callers_may_change_their_states():
    name, state = next(iter(evaluation_tasks("PandaPush-v1").items()))
    before = state.clone()
    state["desired_goal"] += 1.0
    assert (evaluation_tasks("PandaPush-v1")[name] == before).all()


def test_an_id_that_is_registered_again_has_other_tasks():
    distances = []
    for goal_xy_range in (0.1, 0.3):
        task = partial(torch_panda.Push, goal_xy_range=goal_xy_range)
        robot = partial(torch_panda.Panda, block_gripper=True)
        torch_panda.register("PushAgain-v0", robot=robot, task=task)
        state = evaluation_tasks("PushAgain-v0")["very_far"]
        offset = state["object_pose"][0, :3] - state["desired_goal"]
        distances.append(float(offset.norm()))
    assert distances[0] < distances[1]
