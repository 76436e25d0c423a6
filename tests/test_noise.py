"""Noise and delay around an environment."""

import pickle
from contextlib import closing

import pytest
import torch
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

import torch_panda
from torch_panda.noise import ActionDelay, ActionNoise, ObservationNoise

N, STEPS = 2, 6


def make(*transforms):
    env = torch_panda.make("PandaReach-v1", num_envs=N, seed=0)
    return closing(TransformedEnv(env, Compose(*transforms)))


class Recorded(torch_panda.Reach):
    """Rewards the sum of the action that arrives, so that a test can see it."""

    def reward(self, simulation, action, achieved_goal, desired_goal):
        return action.sum(1, keepdim=True)


def arrived(*transforms, actions, reset_after=None):
    """Sums of the actions that arrive at the environment, (steps, N)."""
    base = torch_panda.RobotTaskEnv(
        robot=torch_panda.Panda(block_gripper=True), task=Recorded(), num_envs=N
    )
    with closing(TransformedEnv(base, Compose(*transforms))) as env:
        td, sums = env.reset(), []
        for step, action in enumerate(actions):
            td["action"] = action
            after = env.step(td)
            assert torch.equal(after["action"], action)  # the policy's action is stored
            sums.append(after["next", "reward"].flatten())
            td = after["next"]
            if step == reset_after:
                td["_reset"] = torch.tensor([[True], [False]])
                td = env.reset(td)
    return torch.stack(sums)


def numbered():
    """Actions whose sums are 0.03, 0.06, ..."""
    steps = torch.arange(1, STEPS + 1).float() / 100
    return steps[:, None, None].expand(STEPS, N, 3)


def test_actions_arrive_late():
    sums = arrived(ActionDelay(2), actions=numbered())
    expected = torch.tensor([0, 0, 1, 2, 3, 4]) * 0.03
    for env in range(N):
        torch.testing.assert_close(sums[:, env], expected)


def test_a_reset_restarts_the_delay_of_its_environment():
    sums = arrived(ActionDelay(2), actions=numbered(), reset_after=2)
    after_reset = torch.tensor([0, 0, 1, 0, 0, 4]) * 0.03
    torch.testing.assert_close(sums[:, 0], after_reset)
    torch.testing.assert_close(sums[:, 1], torch.tensor([0, 0, 1, 2, 3, 4]) * 0.03)


def test_noise_of_actions_has_its_size_and_its_seed():
    actions = torch.zeros(40, N, 3)
    first, second = (
        arrived(ActionNoise(0.1, seed=3), actions=actions) for _ in range(2)
    )
    assert torch.equal(first, second)
    assert 0.07 < first.std() / 3**0.5 < 0.14


def test_noise_changes_observations_but_not_goals_or_rewards():
    with make() as plain, make(ObservationNoise(0.01, seed=0)) as noisy:
        check_env_specs(noisy)
        for env in (plain, noisy):
            env.set_seed(0)
        expected, actual = plain.reset(), noisy.reset()
        assert (actual["observation"] != expected["observation"]).all()
        for _ in range(20):
            for td in (expected, actual):
                td["action"] = torch.zeros(N, 3)
            expected, actual = plain.step(expected)["next"], noisy.step(actual)["next"]
            error = actual["observation"] - expected["observation"]
            assert error.all() and error.abs().max() < 0.06
            assert torch.equal(actual["achieved_goal"], expected["achieved_goal"])
            assert torch.equal(actual["reward"], expected["reward"])


def test_noisy_environments_roll_out_and_their_noise_pickles():
    with make(ActionDelay(1), ActionNoise(0.1), ObservationNoise(0.01)) as env:
        check_env_specs(env)
        assert env.rollout(5).shape == (N, 5)
        noise = pickle.loads(pickle.dumps(env.transform[1]))
        assert noise.inv(env.rand_action(env.reset()))["action"].shape == (N, 3)


def test_noise_leaves_the_global_generator_alone():
    before = torch.random.get_rng_state()
    arrived(ActionNoise(0.1), ObservationNoise(0.1), actions=torch.zeros(3, N, 3))
    assert torch.equal(before, torch.random.get_rng_state())


@pytest.mark.parametrize(
    ("make_transform", "message"),
    [
        (lambda: ActionDelay(0), "steps must be at least 1"),
        (lambda: ActionDelay(1.5), "steps must be an integer"),
        (lambda: ActionNoise(-1.0), "std must be"),
        (lambda: ObservationNoise(float("nan")), "std must be"),
    ],
)
def test_a_bad_delay_and_a_bad_std_are_refused(make_transform, message):
    with pytest.raises((ValueError, TypeError), match=message):
        make_transform()
