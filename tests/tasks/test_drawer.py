"""Drawer: starts, goals and the friction of its slide."""

import math

import numpy as np
import pytest
import torch

import torch_panda
from torch_panda import Drawer


def test_goals_are_within_the_slide_and_far_enough_from_the_start():
    task, rng = Drawer(), np.random.default_rng(0)
    for _ in range(200):
        start = task.sample_start(rng)
        ((x, y, *_),), (opening,) = start.object_pose, start.object_joint_position
        goal_opening = x - 0.06 - start.goal[0]
        assert 0 <= opening <= 0.25
        assert 0 <= goal_opening <= 0.25
        assert abs(goal_opening - opening) >= 0.1
        assert start.goal[1:] == [y, 0.06]


def test_a_drawer_opened_as_far_as_the_goal_asks_is_a_success():
    """Also for a cabinet that is turned."""
    with torch_panda.make("PandaDrawer-v1", num_envs=4, seed=0) as env:
        td = env.reset()
        assert not td["success"].any()
        state = env.get_state()
        x, goal = state["object_pose"][:, 0, 0], state["desired_goal"]
        state["object_joint_position"] = (x - 0.06 - goal[:, 0]).unsqueeze(1)
        td = env.reset(state, set_state=True)
        torch.testing.assert_close(td["achieved_goal"], goal.float())
        assert td["success"].all()
        # A cabinet that is turned by 90 degrees opens along -y.
        turned = torch.tensor((0.0, 0.0, math.sin(math.pi / 4), math.cos(math.pi / 4)))
        state["object_pose"][:, 0, 3:] = turned
        state["object_joint_position"][:] = 0.1
        td = env.reset(state, set_state=True)
        place = td["achieved_goal"].double() - state["object_pose"][:, 0, :3]
        expected = torch.tensor((0.0, -0.16, 0.06), dtype=torch.float64).expand(4, 3)
        torch.testing.assert_close(place, expected, atol=1e-6, rtol=0)


def test_friction_stops_the_drawer():
    """A force of 5 N stops 1 kg at 0.5 m/s within 2.5 cm, as v^2 m / (2 F) says."""
    moved = []
    for force in (5.0, 2.5):
        options = {"drawer_friction": force}
        with torch_panda.make("PandaDrawer-v1", seed=0, task_options=options) as env:
            env.reset()
            state = env.get_state()
            state["object_joint_position"][:] = 0.05
            state["object_joint_velocity"][:] = 0.5
            td = env.reset(state, set_state=True)
            for _ in range(15):
                td = env.step(td.set("action", torch.zeros(3)))["next"]
            assert td["observation"][-1].abs() < 1e-3
            moved.append(td["observation"][-2].item() - 0.05)
    assert moved[0] == pytest.approx(0.025, rel=0.1)
    assert moved[1] == pytest.approx(0.05, rel=0.1)
