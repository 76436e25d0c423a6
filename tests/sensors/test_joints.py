"""The sensor "joint_state"."""

import torch

import torch_panda

SENSORS = ("joint_state",)


def test_joint_state_observes_the_joints_of_the_state():
    with torch_panda.make("PandaPush-v1", num_envs=2, seed=0, sensors=SENSORS) as env:
        following = env.rollout(5)["next"][:, -1]
        state = env.get_state()
        for key in ("joint_position", "joint_velocity"):
            assert torch.equal(following[key], state[key].float())


def test_a_reset_takes_observed_joints_for_an_observation():
    with torch_panda.make("PandaReach-v1", num_envs=2, seed=0, sensors=SENSORS) as env:
        td = env.rollout(5)[:, -1]["next"].exclude("reward")
        mask = torch.tensor([[True], [False]])
        start = env.reset(td.clone().set("_reset", mask))
        neutral = torch.tensor(env.robot.neutral_joint_position)
        torch.testing.assert_close(start["joint_position"][0], neutral)
        assert torch.equal(start["joint_position"][1], td["joint_position"][1])


def test_a_reset_to_a_state_observes_its_joints():
    with torch_panda.make("PandaReach-v1", num_envs=2, seed=0, sensors=SENSORS) as env:
        expected = env.rollout(5)[:, -1]["next"]
        state = env.get_state()
        for options in ({}, {"set_state": True}):
            env.reset()
            start = env.reset(state, **options)
            for key in ("joint_position", "joint_velocity"):
                assert torch.equal(start[key], expected[key])
