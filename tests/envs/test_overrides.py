"""Functions that a subclass overrides are called, and changed options take effect."""

import pytest
import torch

import torch_panda
from torch_panda import Panda, Push, RobotTaskEnv

N = 3


class FarPush(Push):
    """An achieved goal and a success of its own, both displaced by 1 m."""

    goal_entries = None

    def achieved_goal(self, simulation):
        return super().achieved_goal(simulation) + 1.0

    def success_distance(self, achieved_goal, desired_goal):
        return self.distance(achieved_goal, desired_goal + 1.0)


class OwnRobot(Panda):
    """A robot that moves and observes in the opposite direction."""

    def arm_setpoint(self, action, simulation):
        return super().arm_setpoint(-action, simulation)

    def observation(self, simulation):
        return -super().observation(simulation)


class OwnStep(RobotTaskEnv):
    """An environment with a reward of its own."""

    def _step(self, tensordict):
        return super()._step(tensordict).set("reward", torch.full((N, 1), 7.0))


def make(task=None, robot=None):
    robot, task = robot or Panda(block_gripper=True), task or Push()
    return RobotTaskEnv(robot=robot, task=task, num_envs=N, seed=0)


def step(env, action):
    return env.step(env.reset().set("action", torch.full((N, 3), action)))["next"]


def test_a_tasks_own_goal_and_success_are_used():
    with make() as env, make(FarPush()) as far:
        plain, other = step(env, 1.0), step(far, 1.0)
    moved = plain["achieved_goal"].double() + 1.0
    assert other["achieved_goal"].allclose(moved.float())
    assert other["success"].equal(plain["success"])


def test_a_robots_own_setpoint_and_observation_are_used():
    with make() as env, make(robot=OwnRobot(block_gripper=True)) as own:
        plain, other = step(env, 1.0), step(own, -1.0)
    expected = plain["observation"].clone()
    expected[:, :6] *= -1
    assert other["observation"].equal(expected)


def test_an_environments_own_step_is_used():
    with OwnStep(robot=Panda(block_gripper=True), task=Push(), num_envs=N) as env:
        assert (step(env, 1.0)["reward"] == 7.0).all()
        assert (env.rollout(2)["next", "reward"] == 7.0).all()


@pytest.mark.parametrize("threshold", [0.0, 0.04, 1e30])
def test_success_and_reward_follow_a_threshold_that_changes_later(threshold):
    with torch_panda.make("PandaPush-v3", num_envs=N, seed=0) as env:
        env.task.distance_threshold = threshold
        td = env.reset()
        state = env.get_state()
        state["desired_goal"][1:] = state["object_pose"][1:, 0, :3]
        state["desired_goal"][1, 0] += 0.03
        td = env.reset(state, set_state=True)
        td = env.step(td.set("action", torch.zeros(N, 3)))["next"]
    distance = (td["achieved_goal"] - td["desired_goal"]).norm(dim=1, keepdim=True)
    assert td["success"].equal(distance < threshold)
    assert td["reward"].equal(-(distance > threshold).float())
    assert td["terminated"].equal(td["success"])


def test_the_callers_action_is_kept_and_not_changed():
    with make() as env:
        start = env.reset()
        action = torch.full((N, 3), 2.0)
        env.step(start.set("action", action))
        assert (action == 2.0).all()
        action.zero_()
        state = env.get_state(exact=True)
        assert (state["actions"] == 1.0).all()


def test_a_step_refuses_a_locked_tensordict():
    with make() as env:
        td = env.reset().set("action", torch.ones(N, 3)).lock_()
        with pytest.raises(RuntimeError, match="locked"):
            env.step(td)
