"""Runs both columns of the tables for users of panda-gym and Fetch."""

import functools
import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

import torch_panda
from tests.panda_gym_reference import make_reference
from torch_panda.gymnasium_envs.sb3 import SB3VecEnv

GUIDE = Path(torch_panda.__file__).parent / "gymnasium_envs" / "README.md"
A, D = np.float32([0.1, 0.0, 0.02]), np.float32([0.0, 0.1, 0.02])


def rows(title):
    section = GUIDE.read_text().split(f"## {title}")[1].split("\n## ")[0]
    cells = re.findall(r"^\| `(.+?)` \| `(.+?)` \|$", section, re.MULTILINE)
    assert len(cells) >= 7
    return cells


def run(code, env, make):
    names = {
        "gymnasium": gymnasium,
        "torch": torch,
        "SubprocVecEnv": functools.partial(SubprocVecEnv, start_method="fork"),
        "SB3VecEnv": SB3VecEnv,
        "make": make,
        "env": env,
        "a": A,
        "d": D,
    }
    return eval(code, names)


def check_alike(theirs, ours, *, is_fetch):
    """Compare the interfaces of two environments, or the values of two results."""
    if isinstance(theirs, VecEnv | gymnasium.Env):
        results = [observe_types(env, 2) for env in (theirs, ours)]
        for env in (theirs, ours):
            env.close()
        first, second = results
        if is_fetch:  # another robot has other sizes, and success is a number
            first, second = (
                {key: dtype for key, (dtype, _) in result.items()} for result in results
            )
            assert (first.pop("is_success"), second.pop("is_success")) == ("f", "b")
        assert first == second
    elif np.ndim(theirs) == 3:  # a picture
        assert theirs.shape == ours.shape
    else:
        np.testing.assert_allclose(np.ravel(theirs), np.ravel(ours), atol=1e-6)


def observe_types(env, steps):
    """Types and shapes of the results of a reset and a step, by name."""
    start = env.reset()
    observation = start if isinstance(env, VecEnv) else start[0]
    result = {key: described(value) for key, value in observation.items()}
    count = env.num_envs if isinstance(env, VecEnv) else None
    for _ in range(steps):
        action = np.zeros(env.action_space.shape, np.float32)
        if count is not None:
            action = np.stack([action] * count)
        _, reward, done, *_, info = env.step(action)
    infos = [info] if count is None else info
    result |= {"reward": described(reward), "done": described(done)}
    result["is_success"] = described(infos[0]["is_success"])
    result["action"] = described(env.action_space.sample())
    return result


def described(value):
    """Kind of the dtype, and shape."""
    array = np.asarray(value)
    return array.dtype.kind, array.shape


def check_row(theirs, ours, env, make, *, is_fetch):
    """Run both columns of a row, theirs in the environment that a function makes."""
    reference = make()
    for environment in (env, reference):
        environment.reset(seed=0)
    results = [run(theirs, reference, make), run(ours, env, make)]
    check_alike(*results, is_fetch=is_fetch)
    for environment in (env, reference):
        environment.close()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("theirs", "ours"), rows("From panda-gym 3"))
def test_both_columns_of_the_panda_gym_table_agree(theirs, ours):
    env = gymnasium.make("torch_panda/PandaPush-v3", render_mode="rgb_array")
    make = functools.partial(make_reference, "PandaPush-v3", render_mode="rgb_array")
    check_row(theirs, ours, env, make, is_fetch=False)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("theirs", "ours"), rows("From Fetch"))
def test_both_columns_of_the_fetch_table_agree(theirs, ours):
    robotics = pytest.importorskip(
        "gymnasium_robotics", reason="needs gymnasium-robotics, which brings MuJoCo"
    )
    gymnasium.register_envs(robotics)
    env = gymnasium.make("torch_panda/PandaPush-v1")
    make = functools.partial(gymnasium.make, "FetchPush-v4")
    check_row(theirs, ours, env, make, is_fetch=True)


@pytest.mark.filterwarnings("ignore")
def test_fetch_has_the_same_clock():
    """Episodes have 50 steps of 40 ms."""
    robotics = pytest.importorskip(
        "gymnasium_robotics", reason="needs gymnasium-robotics, which brings MuJoCo"
    )
    gymnasium.register_envs(robotics)
    ours = gymnasium.make("torch_panda/PandaPush-v1")
    theirs = gymnasium.make("FetchPush-v4")
    step = ours.unwrapped.torch_env.physics.ctrl_dt
    assert step == pytest.approx(theirs.unwrapped.dt) == pytest.approx(0.04)
    assert ours.spec.max_episode_steps == theirs.spec.max_episode_steps == 50
    ours.close()
    theirs.close()


def test_an_episode_continues_from_an_exact_state():
    """As panda-gym's `restore_state` is meant to do."""
    env = gymnasium.make("torch_panda/PandaPush-v3")
    env.reset(seed=0)
    action = np.float32([0.3, 0.2, -1.0])
    for _ in range(5):
        env.step(action)
    state = env.unwrapped.torch_env.get_state(exact=True)
    expected = env.step(action)[0]
    env.reset(options={"state": state})
    np.testing.assert_equal(env.step(action)[0], expected)
    env.close()


PANDA_GYM_NAMES = {
    "sim": r"use env\.unwrapped\.torch_env, which has get_state\(\)",
    "save_state": r"use env\.unwrapped\.torch_env\.get_state\(exact=True\)",
    "render_yaw": r"argument render_yaw .* or .*Camera\(yaw=\.\.\.\)",
}


@pytest.fixture(scope="module")
def adapters():
    made = (
        gymnasium.make("torch_panda/PandaReach-v3"),
        gymnasium.make_vec("torch_panda/PandaReach-v3", num_envs=2),
        SB3VecEnv("PandaReach-v3", num_envs=2),
    )
    yield made
    for env in made:
        env.close()


@pytest.mark.parametrize("name", PANDA_GYM_NAMES)
def test_attributes_of_panda_gym_are_refused_with_their_replacement(adapters, name):
    assert hasattr(make_reference("PandaReach-v3").unwrapped, name)
    for env in adapters:
        message = f"no attribute '{name}': .*{PANDA_GYM_NAMES[name]}"
        with pytest.raises(AttributeError, match=message):
            getattr(env.unwrapped, name)
        with pytest.raises(AttributeError, match=message):
            setattr(env.unwrapped, name, 1)
        with pytest.raises(AttributeError, match=r"no attribute 'wings'$"):
            _ = env.unwrapped.wings
        assert env.unwrapped.torch_env.task.reward_type == "sparse"


@pytest.mark.parametrize("name", ["distance_threshold", "reward_type", "block_gripper"])
def test_options_of_the_task_and_the_robot_are_refused(adapters, name):
    for env in adapters:
        with pytest.raises(AttributeError, match=f"{name} is an option of the"):
            setattr(env.unwrapped, name, 0.5)
    with pytest.raises(AttributeError, match=f"{name} is an option of the"):
        adapters[-1].set_attr(name, 0.5)
