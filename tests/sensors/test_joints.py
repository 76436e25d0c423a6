"""The sensor "joint_state"."""

import pytest
import torch
from torchrl.envs.utils import check_env_specs

import torch_panda
from tests.test_custom import make_kuka
from torch_panda import Reach, RobotTaskEnv

SENSORS = ("joint_state",)


@pytest.mark.parametrize("num_envs", [None, 2])
def test_specs(num_envs):
    batch = () if num_envs is None else (num_envs,)
    with torch_panda.make("PandaPush-v1", num_envs=num_envs, sensors=SENSORS) as env:
        check_env_specs(env)
        following = env.rollout(3)["next"]
        for key in ("joint_position", "joint_velocity"):
            assert following[key].shape == (*batch, 3, 9)
            assert following[key].dtype == torch.float32


def test_the_sensor_has_a_value_for_each_joint_of_another_robot():
    with RobotTaskEnv(robot=make_kuka(), task=Reach(), sensors=SENSORS) as env:
        assert env.reset()["joint_position"].shape == (7,)


def test_an_episode_starts_at_the_neutral_position_and_at_rest():
    with torch_panda.make("PandaPickAndPlace-v1", sensors=SENSORS) as env:
        td = env.reset()
        neutral = torch.tensor(env.robot.neutral_joint_position)
        torch.testing.assert_close(td["joint_position"], neutral)
        assert (td["joint_velocity"] == 0).all()


def test_it_observes_the_joints_of_the_state():
    with torch_panda.make("PandaPush-v1", num_envs=2, seed=0, sensors=SENSORS) as env:
        following = env.rollout(5)["next"][:, -1]
        state = env.get_state()
        for key in ("joint_position", "joint_velocity"):
            assert torch.equal(following[key], state[key].float())


def test_velocities_are_those_at_which_positions_change():
    options = {"control_type": "joint_velocity"}
    with torch_panda.make("PandaReach-v1", sensors=SENSORS, robot_options=options) as e:
        td, positions = e.reset(), []
        for _ in range(6):
            td = e.step(td.set("action", torch.full((7,), 0.2)))["next"]
            positions.append(td["joint_position"])
        change = (positions[-1] - positions[-2])[:7] / 0.04
        torch.testing.assert_close(td["joint_velocity"][:7], change, atol=5e-3, rtol=0)
        assert (change.abs() > 0.2).all()


def test_steps_do_not_overwrite_earlier_observations():
    with torch_panda.make("PandaReach-v1", seed=0, sensors=SENSORS) as env:
        td = env.rand_step(env.reset())
        before = td["next", "joint_position"].clone()
        env.rand_step(td["next"].exclude("reward"))
        assert torch.equal(td["next", "joint_position"], before)


def test_a_reset_takes_observed_joints_for_an_observation():
    with torch_panda.make("PandaReach-v1", num_envs=2, seed=0, sensors=SENSORS) as env:
        td = env.rollout(5)[:, -1]["next"].exclude("reward")
        mask = torch.tensor([[True], [False]])
        start = env.reset(td.clone().set("_reset", mask))
        neutral = torch.tensor(env.robot.neutral_joint_position)
        torch.testing.assert_close(start["joint_position"][0], neutral)
        assert torch.equal(start["joint_position"][1], td["joint_position"][1])


def test_a_reset_starts_from_a_state():
    with torch_panda.make("PandaReach-v1", num_envs=2, seed=0, sensors=SENSORS) as env:
        expected = env.rollout(5)[:, -1]["next"]
        state = env.get_state()
        for options in ({}, {"set_state": True}):
            env.reset()
            start = env.reset(state, **options)
            for key in ("joint_position", "joint_velocity"):
                assert torch.equal(start[key], expected[key])
