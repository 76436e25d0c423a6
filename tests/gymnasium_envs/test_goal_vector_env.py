"""`GoalVectorEnv` returns the same values as SyncVectorEnv."""

import contextlib
import gc

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import torch_panda
from torch_panda.gymnasium_envs import GoalEnv, GoalVectorEnv

NUM_ENVS = 3
# In Reach-v3, success ends episodes at different times. In the others, the time limit
# ends them.
CASES = [("PandaReach-v3", None), ("PandaPushDense-v1", 7)]


def make_pair(env_id, mode, limit):
    """`GoalVectorEnv`, and SyncVectorEnv over single environments."""
    env_id = f"torch_panda/{env_id}"
    limits = {} if limit is None else {"max_episode_steps": limit}
    ours = gymnasium.make_vec(
        env_id,
        num_envs=NUM_ENVS,
        vectorization_mode="vector_entry_point",
        autoreset_mode=mode,
        **limits,
    )
    singles = [lambda: gymnasium.make(env_id, **limits)] * NUM_ENVS
    return ours, SyncVectorEnv(singles, autoreset_mode=mode)


def act(observation, rng):
    """Move towards the goal, with another speed in each environment."""
    towards = observation["desired_goal"] - observation["achieved_goal"]
    noise = rng.uniform(-0.3, 0.3, towards.shape)
    speed = np.array([[8.0], [3.0], [5.0]])
    return np.clip(towards * speed + noise, -1, 1).astype(np.float32)


@pytest.mark.parametrize("mode", AutoresetMode)
@pytest.mark.parametrize(("env_id", "limit"), CASES)
def test_values_equal_those_of_sync_vector_env(env_id, limit, mode):
    ours, theirs = make_pair(env_id, mode, limit)
    assert isinstance(ours, GoalVectorEnv)
    assert ours.metadata["autoreset_mode"] is ours.autoreset_mode is mode
    for space in ("observation_space", "action_space", "single_observation_space"):
        assert getattr(ours, space) == getattr(theirs, space)
    rng = np.random.default_rng(0)
    result = ours.reset(seed=3)
    assert data_equivalence(result, theirs.reset(seed=3), exact=True)
    ends = []
    for step in range(50):
        actions = act(result[0], rng)
        result = ours.step(actions)
        assert data_equivalence(result, theirs.step(actions), exact=True)
        ended = result[2] | result[3]
        ends.append(ended)
        if mode is AutoresetMode.DISABLED and ended.any():
            with pytest.raises(ResetNeeded, match=str(int(ended.nonzero()[0][0]))):
                ours.step(actions)
            # Some environments get a new seed, the others start their next episode.
            seeds = [7, None, step]
            result = ours.reset(seed=seeds, options={"reset_mask": ended})
            options = {"reset_mask": ended}
            expected = theirs.reset(seed=seeds, options=options)
            assert data_equivalence(result, expected, exact=True)
    ours.close()
    theirs.close()
    assert np.sum(ends, axis=0).min() >= 3


def test_the_default_autoreset_mode_is_next_step():
    env = gymnasium.make_vec("torch_panda/PandaReach-v1", num_envs=1)
    env.close()
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP


def test_a_reset_starts_masked_environments_from_a_state():
    env = GoalVectorEnv("PandaPush-v1", num_envs=2)
    env.reset(seed=0)
    first, *_ = env.step(np.ones((2, 3)))
    state = env.torch_env.get_state()
    env.step(np.ones((2, 3)))
    mask = np.array([False, True])
    again, infos = env.reset(options={"state": state, "reset_mask": mask})
    env.close()
    assert infos["_is_success"].tolist() == [False, True]
    pose = slice(6, 9)
    assert np.array_equal(again["observation"][1, pose], first["observation"][1, pose])
    assert not np.array_equal(again["observation"][0], first["observation"][0])


@pytest.mark.parametrize("mode", AutoresetMode)
def test_the_default_device_changes_nothing(mode):
    with torch.device("meta"):
        env = GoalVectorEnv(
            "PandaReach-v1", num_envs=2, max_episode_steps=2, autoreset_mode=mode
        )
        env.reset(seed=0)
        env.step(np.zeros((2, 3)))
        ended = env.step(np.zeros((2, 3)))[3]
        observation, _ = env.reset(options={"reset_mask": ended})
        env.close()
    assert observation["observation"].shape == (2, 6)


def test_a_diverged_episode_keeps_its_goal_if_another_one_starts():
    env = GoalVectorEnv(
        "PandaPush-v1", num_envs=2, max_episode_steps=2, on_divergence="reset"
    )
    with contextlib.closing(env):
        env.reset(seed=0)
        env.step(np.zeros((2, 3)))
        env.reset(options={"reset_mask": np.array([True, False])})
        start, *_, ended, _ = env.step(np.zeros((2, 3)))
        assert ended.tolist() == [False, True]
        simulation = env.torch_env.episodes.simulation
        cube, client = simulation.scene.objects[0], simulation.clients[0]
        client.set_base(cube, (0, 0, 0.02), (0, 0, 0, 1), (1e300, 0, 0), (0, 0, 0))
        after, *_, ended, _ = env.step(np.zeros((2, 3)))
        assert ended.tolist() == [True, False]
        same = after["desired_goal"] == start["desired_goal"]
        assert same.all(axis=1).tolist() == [True, False]


def test_a_step_before_the_first_reset_is_refused():
    env = GoalVectorEnv("PandaReach-v1", num_envs=2)
    with pytest.raises(ResetNeeded, match=r"reset environments \[0, 1\]"):
        env.step(np.zeros((2, 3)))
    env.close()


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED])
def test_the_first_reset_starts_all_environments(mode):
    env = GoalVectorEnv("PandaReach-v1", num_envs=2, autoreset_mode=mode)
    with contextlib.closing(env):
        env.reset(seed=0, options={"reset_mask": np.array([True, False])})
        _, reward, *_ = env.step(np.zeros((2, 3), dtype=np.float32))
        assert reward.tolist() == [-1, -1]
        assert env.torch_env.episodes.step_count.flatten().tolist() == [1, 1]


@pytest.fixture(scope="module")
def env():
    env = GoalVectorEnv("PandaReach-v1", num_envs=3)
    yield env
    env.close()


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"seed": [1, 2]}, ValueError, "3 seeds, got 2"),
        ({"seed": [1, -2, 3]}, ValueError, "non-negative"),
        ({"options": {"mask": 1}}, ValueError, "only accepted option is .state"),
        ({"options": {"state": {}}}, ValueError, "must have entries, got none"),
        ({"options": {"state": None}}, TypeError, "state must be an instance of Map"),
        ({"options": {"state": [1.0]}}, TypeError, "state must be an instance of Map"),
        ({"options": {"state": {"object": [0]}}}, ValueError, "unknown entries .'obje"),
        ({"options": {"reset_mask": [True] * 3}}, TypeError, "array of bool"),
        ({"options": {"reset_mask": np.ones(3)}}, TypeError, "array of bool"),
        (
            {"options": {"reset_mask": np.zeros(3, bool)}},
            ValueError,
            "True for at least one",
        ),
        ({"options": {"reset_mask": np.ones(2, bool)}}, ValueError, r"shape \(3,\)"),
    ],
)
def test_bad_resets_are_refused(env, arguments, error, message):
    with pytest.raises(error, match=message):
        env.reset(**arguments)
    env.reset()
    env.step(np.zeros((3, 3)))


ID = "PandaReach-v1"


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda one, many: GoalEnv(many), ValueError, r"must be \[\], got \[2\]"),
        (
            lambda one, many: GoalVectorEnv(one),
            ValueError,
            r"must be \[num_envs\], got \[\]",
        ),
        (
            lambda one, many: GoalEnv(one, sed=3, from_pixels=True, render_width=8),
            TypeError,
            r"\['from_pixels', 'sed'\] are accepted with an id",
        ),
        (
            lambda one, many: GoalVectorEnv(many, num_envs=2),
            TypeError,
            "num_envs.* are accepted with an id",
        ),
        (
            lambda one, many: GoalVectorEnv(ID, autoreset_mode="Sometimes"),
            ValueError,
            "Sometimes",
        ),
        (
            lambda one, many: GoalVectorEnv(ID, render_mode="human"),
            ValueError,
            "render_mode must be None or one of",
        ),
        (
            lambda one, many: GoalEnv(one, render_camera="front"),
            TypeError,
            "render_camera must be an instance of Camera",
        ),
    ],
)
def test_bad_arguments_are_refused(call, error, message):
    with (
        torch_panda.make(ID) as one,
        torch_panda.make(ID, num_envs=2) as many,
        pytest.raises(error, match=message),
    ):
        call(one, many)
    gc.collect()
