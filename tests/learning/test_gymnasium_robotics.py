"""Environments of Gymnasium-Robotics are learned in, or run at least."""

import pytest

from torch_panda.commands import train
from torch_panda.commands.train import parse
from torch_panda.learning.environments.geometry import find_geometry, find_hand, probe
from torch_panda.learning.environments.gym_goal_env import GymGoalEnv
from torch_panda.learning.evaluation import evaluate
from torch_panda.learning.files.policy_files import load_policy

pytest.importorskip("gymnasium_robotics")
pytestmark = pytest.mark.slow


def learn(env_id, steps, out, *options):
    arguments = ["--env-id", env_id, "--total-steps", str(steps), "--no-video"]
    train.main(parse([*arguments, "--out", str(out), *options]))
    return load_policy(out)


@pytest.mark.timeout(1200)
def test_the_script_learns_fetch_reach_in_1200_steps(tmp_path):
    from examples import fetch

    assert fetch.main(tmp_path / "fetch_reach").success_rate >= 0.9


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(
    "env_id", ["FetchPush-v4", "PointMaze_UMaze-v3", "HandManipulateBlock-v1"]
)
def test_a_training_runs(tmp_path, env_id):
    options = ["--num-envs", "2", "--updates-per-step", "0.1"]
    policy = learn(env_id, 100, tmp_path, *options)
    assert len(evaluate(policy, env_id, episodes=2).success) == 2


def test_the_hand_and_the_object_of_fetch_are_found():
    with GymGoalEnv("FetchPush-v4", num_envs=4, seed=0) as env:
        rollouts = probe(env)
    hand = find_hand(rollouts)
    assert hand.column == 0
    assert find_geometry(rollouts, hand.column).positions == (0, 3)
