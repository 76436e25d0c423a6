"""`Task.info` is reported by all interfaces, and never observed."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from torchrl.envs import SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

import torch_panda
from torch_panda import Panda, Reach
from torch_panda.datasets import generate
from torch_panda.gymnasium_envs import GoalVectorEnv
from torch_panda.gymnasium_envs.sb3 import SB3VecEnv
from torch_panda.transforms import HindsightRelabel

ID = "Costly-v0"


class Costly(Reach):
    """Reach with a cost of the hand's height, and two other infos."""

    def info(self, simulation):
        height = simulation.ee_position[:, 2:]
        return {
            "cost": height,
            "is_low": simulation.ee_position[:, 2] < 0.15,
            "hand": simulation.ee_orientation,
        }

    def extra_observation(self, simulation):
        return {"orientation": simulation.ee_orientation}


@pytest.fixture(autouse=True)
def costly():
    torch_panda.register(
        ID,
        robot=lambda **options: Panda(block_gripper=True, **options),
        task=Costly,
        max_episode_steps=4,
    )


@pytest.mark.parametrize("num_envs", [None, 3])
def test_torchrl_returns_infos_under_next(num_envs):
    with torch_panda.make(ID, num_envs=num_envs, seed=0) as env:
        check_env_specs(env)
        batch = env.batch_size
        assert env.observation_spec["cost"].shape == (*batch, 1)
        assert env.observation_spec["is_low"].dtype == torch.bool
        after = env.rollout(3)["next"]
        # The entries of the robot begin with the position of the hand.
        assert torch.equal(after["cost"], after["observation"][..., 2:3])
        assert torch.equal(after["is_low"], after["observation"][..., 2] < 0.15)
        assert after["hand"].shape == (*batch, 3, 4)
        assert after["observation"].shape == (*batch, 3, 6)
        assert after["cost"].dtype == torch.float32


def test_infos_pass_through_torchrls_wrappers():
    def transformed():
        return TransformedEnv(torch_panda.make(ID, seed=0), StepCounter())

    for env in (SerialEnv(2, transformed), transformed()):
        assert (env.rollout(3)["next", "cost"] > 0).all()
        env.close(raise_if_closed=False)


def test_a_partial_reset_keeps_the_infos_of_others():
    with torch_panda.make(ID, num_envs=2, seed=0) as env:
        td = env.rollout(3)[:, -1]["next"]
        td["_reset"] = torch.tensor([[True], [False]])
        start = env.reset(td.clone())
        assert torch.equal(start["cost"][1], td["cost"][1])
        assert not torch.equal(start["cost"][0], td["cost"][0])


def test_gymnasium_returns_infos_outside_the_observation():
    env = gymnasium.make(f"torch_panda/{ID}")
    observation, info = env.reset(seed=0)
    assert set(observation) == set(env.observation_space)
    expected = {"achieved_goal", "desired_goal", "observation", "orientation"}
    assert set(observation) == expected
    for _ in range(4):
        assert info["cost"].shape == (1,) and info["is_low"].shape == ()
        assert info["cost"] == observation["observation"][2]
        assert info["is_low"] == (observation["observation"][2] < 0.15)
        observation, *_, info = env.step(env.action_space.sample())
    env.close()


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_a_vector_returns_the_infos_of_gymnasiums_own(mode):
    ours = GoalVectorEnv(ID, num_envs=2, autoreset_mode=mode)
    theirs = SyncVectorEnv(
        [lambda: gymnasium.make(f"torch_panda/{ID}")] * 2, autoreset_mode=mode
    )
    results = []
    for env in (ours, theirs):
        infos = [env.reset(seed=0)[1]]
        actions = np.random.default_rng(0).uniform(-1, 1, (9, 2, 3))
        infos += [env.step(action.astype(np.float32))[-1] for action in actions]
        if mode is AutoresetMode.NEXT_STEP:
            env.reset(seed=0)
        assert all("cost" in info for info in infos)
        results.append(infos)
        env.close()
    has_final = any("final_info" in info for info in results[0])
    assert has_final == (mode.value != "NextStep")
    for info in results[0] + results[1]:
        for key in ("final_obs", "_final_obs"):
            info.pop(key, None)
    np.testing.assert_equal(results[0], results[1])


def test_a_masked_reset_has_zeros_where_nothing_was_reset():
    env = GoalVectorEnv(ID, num_envs=2, autoreset_mode="Disabled")
    env.reset(seed=0)
    _, info = env.reset(options={"reset_mask": np.array([False, True])})
    assert info["_cost"].tolist() == [False, True]
    assert info["cost"][0] == 0 < info["cost"][1]
    env.close()


def test_stable_baselines3_gets_the_infos_of_the_last_step_of_an_episode():
    env = SB3VecEnv(ID, num_envs=2, seed=0)
    env.reset()
    assert [info["cost"].shape for info in env.reset_infos] == [(1,), (1,)]
    up = np.float32([[0, 0, 1], [0, 0, 0.5]])
    for _ in range(4):
        observation, _, done, infos = env.step(up)
        for index, info in enumerate(infos):
            last = info.get("terminal_observation", observation)["observation"]
            height = last[2] if done[index] else last[index, 2]
            assert info["cost"] == height
    assert done.all()
    for index, info in enumerate(env.reset_infos):
        assert (
            info["cost"] == observation["observation"][index, 2] != infos[index]["cost"]
        )
    env.close()


def test_infos_are_not_part_of_goals_that_are_full_observations():
    with torch_panda.make(ID, num_envs=2, goal="observation") as env:
        td = env.reset()
        assert td["desired_goal"].shape == td["observation"].shape == (2, 6)
        HindsightRelabel.from_env(env)


def test_generated_data_hold_infos_under_next_only():
    data = generate(ID, kind="random", transitions=8, seed=0, num_envs=2)
    assert data["next", "cost"].shape == (2, 4, 1)
    keys = set(data.keys())
    assert "orientation" in keys and "cost" not in keys
