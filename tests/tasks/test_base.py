"""Rewards by hand."""

import math

import pybullet
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torch_panda import Flip, Push, Stack
from torch_panda.rotations import rotate

angle = st.floats(-math.pi, math.pi)


@given(angle, angle, angle)
def test_rotate_equals_pybullet(roll, pitch, yaw):
    quaternion = pybullet.getQuaternionFromEuler((roll, pitch, yaw))
    vector = torch.tensor([[0.3, -0.2, 0.7], [-1.0, 2.0, 0.5]], dtype=torch.float64)
    matrix = torch.tensor(pybullet.getMatrixFromQuaternion(quaternion)).reshape(3, 3)
    found = rotate(torch.tensor(quaternion, dtype=torch.float64), vector)
    torch.testing.assert_close(found, vector @ matrix.double().T, atol=1e-6, rtol=0)


def test_rewards_by_hand():
    goal = torch.zeros(2, 3)
    achieved = torch.tensor([[0.03, 0.0, 0.04], [0.03, 0.0, 0.039]])
    assert Push().is_success(achieved, goal).flatten().tolist() == [False, True]
    dense = Push(reward_type="dense").compute_reward(achieved[:1], goal[:1])
    torch.testing.assert_close(dense, torch.tensor([[-0.05]]))


def test_stack_compares_each_cube_or_both():
    goal = torch.zeros(6)
    achieved = torch.tensor([0.04, 0.0, 0.0, 0.0, 0.06, 0.0])
    assert not Stack().is_success(achieved, goal)
    norm = Stack(distance_threshold=0.1, per_object=False)
    assert norm.is_success(achieved, goal)
    dense = Stack(reward_type="dense").compute_reward(achieved, goal)
    torch.testing.assert_close(dense, torch.tensor([-math.sqrt(0.0052)]))


def test_flip_takes_opposite_quaternions_for_one_orientation():
    quaternion = torch.tensor([0.5, 0.5, 0.5, 0.5])
    assert Flip().is_success(quaternion, -quaternion)
    other = torch.tensor([0.5, -0.5, 0.5, -0.5])
    assert not Flip().is_success(quaternion, other)
    assert Flip(reward_type="dense").compute_reward(quaternion, other) == -1.0


class FromBothSides(Push):
    """Success is a matter of x alone."""

    def is_success(self, achieved_goal, desired_goal):
        return (achieved_goal - desired_goal)[..., :1].abs() < 0.01


class Bonus(Push):
    """Success pays 10, in whole numbers."""

    def compute_reward(self, achieved_goal, desired_goal):
        return 10 * self.is_success(achieved_goal, desired_goal).int()


@pytest.mark.parametrize("reward_type", ["sparse", "dense"])
@pytest.mark.parametrize("kind", [Push, Stack, Flip, FromBothSides, Bonus])
def test_a_step_is_judged_by_what_a_task_overrides(kind, reward_type):
    task = kind(reward_type=reward_type)
    goal, offset = torch.rand(2, 100, task.goal_dim)
    achieved = goal + 0.1 * (offset - 0.5)
    # One at the threshold: neither a success nor unrewarded.
    achieved[0], goal[0], goal[0, 0] = 0.0, 0.0, task.distance_threshold
    success, reward = task.judge(achieved, goal)
    assert 0 < success.sum() < 100 or kind is Flip
    assert torch.equal(success, task.is_success(achieved, goal))
    expected = task.compute_reward(achieved, goal)
    assert torch.equal(reward, expected.float())
    assert reward.dtype == torch.float32


def test_a_step_is_judged_by_what_one_task_has_of_its_own():
    task = Push()
    task.compute_reward = lambda achieved, desired: torch.full((4, 1), 5.0)
    goal = torch.rand(4, 3)
    success, reward = task.judge(goal, goal)
    assert success.all()
    assert (reward == 5).all()


@pytest.mark.parametrize("threshold", [math.nan, -0.01, math.inf])
def test_thresholds_that_are_none(threshold):
    with pytest.raises(ValueError, match="distance_threshold must be finite"):
        Push(distance_threshold=threshold)
