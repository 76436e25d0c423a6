"""Rewards, success and arguments of tasks."""

import math
import pickle
from dataclasses import dataclass

import pybullet
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torch_panda import Flip, Panda, Push, Reach, RobotTaskEnv, Stack
from torch_panda.rotations import rotate

angle = st.floats(-math.pi, math.pi)


@given(angle, angle, angle)
def test_rotate_equals_pybullet(roll, pitch, yaw):
    quaternion = pybullet.getQuaternionFromEuler((roll, pitch, yaw))
    vector = torch.tensor([[0.3, -0.2, 0.7], [-1.0, 2.0, 0.5]], dtype=torch.float64)
    matrix = torch.tensor(pybullet.getMatrixFromQuaternion(quaternion)).reshape(3, 3)
    rotated = rotate(torch.tensor(quaternion, dtype=torch.float64), vector)
    torch.testing.assert_close(rotated, vector @ matrix.double().T, atol=1e-6, rtol=0)


def test_push_succeeds_within_5_cm_and_pays_minus_the_distance():
    goal = torch.zeros(2, 3)
    achieved = torch.tensor([[0.03, 0.0, 0.04], [0.03, 0.0, 0.039]])
    assert Push().is_success(achieved, goal).flatten().tolist() == [False, True]
    dense = Push(reward_type="dense").compute_reward(achieved[:1], goal[:1])
    torch.testing.assert_close(dense, torch.tensor([[-0.05]]))


def test_stack_compares_each_cube_or_the_norm_of_both():
    goal = torch.zeros(6)
    achieved = torch.tensor([0.04, 0.0, 0.0, 0.0, 0.06, 0.0])
    assert not Stack().is_success(achieved, goal)
    norm = Stack(distance_threshold=0.1, per_object=False)
    assert norm.is_success(achieved, goal)
    dense = Stack(reward_type="dense").compute_reward(achieved, goal)
    torch.testing.assert_close(dense, torch.tensor([-math.sqrt(0.0052)]))


def test_opposite_quaternions_are_one_orientation_in_flip():
    quaternion = torch.tensor([0.5, 0.5, 0.5, 0.5])
    assert Flip().is_success(quaternion, -quaternion)
    other = torch.tensor([0.5, -0.5, 0.5, -0.5])
    assert not Flip().is_success(quaternion, other)
    assert Flip(reward_type="dense").compute_reward(quaternion, other) == -1.0


class WholeNumbers(Push):
    """Pays 10 for a success along x, in whole numbers."""

    def is_success(self, achieved_goal, desired_goal):
        return (achieved_goal - desired_goal)[..., :1].abs() < 0.01

    def compute_reward(self, achieved_goal, desired_goal):
        return 10 * self.is_success(achieved_goal, desired_goal).int()


@pytest.mark.parametrize("reward_type", ["sparse", "dense"])
def test_a_step_calls_the_overridden_reward_and_success(reward_type):
    task = WholeNumbers(reward_type=reward_type)
    with RobotTaskEnv(robot=Panda(block_gripper=True), task=task, num_envs=2) as env:
        state = env.reset().update(env.get_state())
        # The goals of the two environments are beside their cubes along y and along x.
        offset = torch.tensor([[0.0, 0.1, 0.0], [0.1, 0.0, 0.0]])
        state["desired_goal"] = state["object_pose"][:, 0, :3] + offset
        td = env.reset(state, set_state=True)
        td = env.step(td.set("action", env.action_spec.zero()))["next"]
    assert td["success"].tolist() == [[True], [False]]
    assert td["reward"].tolist() == [[10.0], [0.0]]
    assert td["reward"].dtype == torch.float32


class Above(Reach):
    """Succeeds when the hand is above its goal."""

    def is_success(self, achieved_goal, desired_goal):
        return (achieved_goal - desired_goal)[..., 2:] > 0


def test_the_sparse_reward_follows_an_overridden_success():
    goals = torch.zeros(2, 3), torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 0.01]])
    assert Above().is_success(*goals).tolist() == [[True], [False]]
    assert Above().compute_reward(*goals).tolist() == [[0.0], [-1.0]]


def test_a_distance_at_the_threshold_is_neither_success_nor_punished():
    task, goal = Push(), torch.zeros(3, dtype=torch.float64)
    achieved = torch.tensor([0.05, 0.0, 0.0], dtype=torch.float64)
    assert not task.is_success(achieved, goal)
    assert task.compute_reward(achieved, goal) == 0.0


class Bonus(Push):
    """A task with arguments of its own, and an ``__init__``."""

    def __init__(self, *, bonus=1.0, **options):
        super().__init__(**options)
        self.bonus = bonus


@dataclass(kw_only=True)
class Penalty(Push):
    """A task with arguments of its own, as a dataclass."""

    penalty: float = 1.0


def test_the_repr_of_a_users_task_shows_its_arguments():
    shown = repr(Bonus(bonus=2.0, object_mass=1.0))
    assert shown.startswith("Bonus(bonus=2.0, reward_type='sparse', ")
    assert "object_mass=1.0" in shown
    assert "penalty=1.0" in repr(Penalty())


@pytest.mark.parametrize("task", [Push(object_mass=1.0), Bonus(object_mass=1.0)])
def test_tasks_are_pickled_with_their_arguments(task):
    copy = pickle.loads(pickle.dumps(task))
    assert type(copy) is type(task)
    assert vars(copy) == vars(task)


def test_tasks_are_compared_and_hashed_by_identity():
    task = Push()
    assert task != Push()
    assert {task: 1}[task] == 1


@pytest.mark.parametrize("task_class", [Push, Penalty])
def test_an_unknown_task_argument_is_named_with_the_accepted_ones(task_class):
    message = (
        f"{task_class.__name__} got an unexpected keyword argument 'threshold'; "
        r"did you mean 'distance_threshold'\? accepted are reward_type, "
    )
    with pytest.raises(TypeError, match=message):
        task_class(threshold=0.02)
    with pytest.raises(TypeError, match="argument 'threshold'"):
        Bonus(threshold=0.02)
