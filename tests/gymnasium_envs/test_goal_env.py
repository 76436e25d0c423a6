"""`GoalEnv` keeps Gymnasium's contract and has the episodes of `RobotTaskEnv`."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from tensordict import TensorDict
from torchrl.envs import GymEnv, GymWrapper
from torchrl.envs.utils import check_env_specs

import torch_panda
from torch_panda.gymnasium_envs import GoalEnv

# check_env advises against spaces without bounds; positions have none.
NO_BOUNDS = "ignore:.*A Box observation space"
# Gymnasium takes -v3 for the successor of -v1; here they are different tasks.
NOT_OLD = r"ignore:.*torch_panda/Panda\w+-v1 is out of date"


@pytest.fixture
def env():
    env = gymnasium.make("torch_panda/PandaPush-v3")
    yield env
    env.close()


@pytest.mark.parametrize("env_id", torch_panda.ENV_IDS)
def test_all_ids_are_registered(env_id):
    spec = gymnasium.spec(f"torch_panda/{env_id}")
    assert spec.max_episode_steps == torch_panda.max_episode_steps(env_id)
    assert spec.vector_entry_point is not None


# Each task, control type, reward and version once; other tests cover all ids.
@pytest.mark.parametrize(
    "env_id",
    [
        "PandaReach-v1",
        "PandaPushJoints-v3",
        "PandaSlideDense-v1",
        "PandaPickAndPlaceJointsDense-v3",
        "PandaStack-v3",
        "PandaFlip-v1",
    ],
)
@pytest.mark.filterwarnings(NO_BOUNDS)
@pytest.mark.filterwarnings(NOT_OLD)
@pytest.mark.filterwarnings("error")
def test_an_environment_keeps_gymnasiums_contract(env_id):
    env = gymnasium.make(f"torch_panda/{env_id}")
    try:
        check_env(env.unwrapped, skip_render_check=True)
        assert all(box.dtype == np.float32 for box in env.observation_space.values())
        limit = 100 if "Stack" in env_id else 50
        env.reset(seed=0)
        ends = []
        while not (ends and any(ends[-1])):
            ends.append(env.step(env.action_space.sample())[2:4])
        assert len(ends) == limit or ends[-1][0]
    finally:
        env.close()


def test_episodes_are_those_of_the_torch_environment(env):
    action = np.random.default_rng(0).uniform(-1, 1, (2, 15, 3)).astype(np.float32)
    with torch_panda.make("PandaPush-v3", seed=5) as other:
        for episode in range(2):
            observation, info = env.reset(seed=5 if episode == 0 else None)
            start = other.reset()
            for key, value in observation.items():
                assert np.array_equal(value, start[key])
            assert info == {"is_success": start["success"].item()}
            for step in range(15):
                observation, reward, terminated, _, info = env.step(
                    action[episode, step]
                )
                after = other.step(
                    TensorDict({"action": torch.from_numpy(action[episode, step])})
                )["next"]
                for key, value in observation.items():
                    assert np.array_equal(value, after[key])
                assert reward == after["reward"].item()
                assert terminated == after["terminated"].item()
                assert info["is_success"] == after["success"].item()


@pytest.mark.filterwarnings(NO_BOUNDS)
def test_pixels_and_sensors_are_observed():
    env = GoalEnv(
        "PandaReach-v1",
        from_pixels=True,
        pixels_only=True,
        segmentation=True,
        render_size=16,
        sensors=("joint_torque",),
    )
    try:
        check_env(env, skip_render_check=True)
        observation, _ = env.reset()
        space = env.observation_space
        assert (
            set(space)
            == set(observation)
            == {
                "achieved_goal",
                "desired_goal",
                "joint_torque",
                "pixels",
                "segmentation",
            }
        )
        assert space["pixels"] == gymnasium.spaces.Box(0, 255, (16, 16, 3), np.uint8)
        assert space["segmentation"].dtype == np.int32
    finally:
        env.close()


@pytest.mark.parametrize("limit", [3, 60])
def test_episodes_are_truncated_at_a_given_time_limit(limit):
    env_id = "PandaReach-v1"
    for env in (
        gymnasium.make(f"torch_panda/{env_id}", max_episode_steps=limit),
        GoalEnv(env_id, max_episode_steps=limit),
    ):
        env.reset(seed=0)
        ends = [env.step(np.zeros(3, np.float32))[2:4] for _ in range(limit)]
        env.close()
        assert ends == [(False, False)] * (limit - 1) + [(False, True)]


@pytest.mark.parametrize("env_id", ["PandaReach-v3", "PandaReachDense-v1"])
def test_reward_and_ends_are_computed_from_arrays_of_goals(env_id):
    env = GoalEnv(env_id)
    achieved = np.zeros((4, 3), np.float32)
    desired = np.array([[0.01, 0, 0], [0.2, 0, 0], [0, 0.03, 0], [0, 0, -1]])
    goals = achieved, desired.astype(np.float32)
    reward = env.compute_reward(*goals, [{}] * 4)
    assert reward.dtype == np.float32
    if env_id == "PandaReach-v3":
        assert reward.tolist() == [0, -1, 0, -1]
        assert env.compute_terminated(*goals, {}).tolist() == [True, False, True, False]
    else:
        np.testing.assert_allclose(reward, [-0.01, -0.2, -0.03, -1], rtol=1e-6)
        assert not env.compute_terminated(*goals, {}).any()
    assert env.compute_truncated(*goals, {}).tolist() == [False] * 4
    one = env.compute_reward(achieved[1], goals[1][1], {})
    assert isinstance(one, np.float32)
    assert one == reward[1]
    with pytest.raises(ValueError, match=r"\(\.\.\., 3\)"):
        env.compute_reward(np.zeros(4), np.zeros(4), {})
    env.close()


def test_an_environment_of_an_own_task_is_accepted():
    task = torch_panda.Reach(distance_threshold=0.2)
    torch_env = torch_panda.RobotTaskEnv(
        robot=torch_panda.Panda(block_gripper=True), task=task, max_episode_steps=4
    )
    env = GoalEnv(torch_env)
    env.reset(seed=0)
    assert env.render() is None
    assert [env.step(np.zeros(3))[3] for _ in range(4)] == [False] * 3 + [True]
    env.close()
    assert torch_env.is_closed


def test_bad_actions_are_refused(env):
    env.reset(seed=0)
    for action in (np.full(3, np.nan), np.zeros(4), "up"):
        with pytest.raises(ValueError, match=r"not finite|shape \(3,\)|convert"):
            env.step(action)
    env.step([0, 0, 1])
    env.close()
    with pytest.raises(torch_panda.BulletError, match="closed"):
        env.step(np.zeros(3))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "make_wrapped",
    [
        lambda: GymEnv("torch_panda/PandaReach-v3"),
        lambda: GymWrapper(gymnasium.make("torch_panda/PandaReach-v3")),
        lambda: GymWrapper(
            gymnasium.make_vec(
                "torch_panda/PandaReach-v3", num_envs=2, autoreset_mode="Disabled"
            )
        ),
    ],
)
def test_torchrls_wrappers_read_the_infos(make_wrapped):
    env = make_wrapped().auto_register_info_dict()
    check_env_specs(env)
    assert env.rollout(3)["next", "is_success"].dtype == torch.bool
    env.close()
