"""Inputs of the networks."""

import pytest
import torch

import torch_panda
from tests.learning.episodes import play_randomly
from tests.learning.gradient_steps import SPACES
from torch_panda.learning.agents import Hyperparameters, make_agent
from torch_panda.learning.agents.normalizer import Normalizer
from torch_panda.learning.environments.geometry import read_geometry
from torch_panda.learning.environments.spaces import read_spaces
from torch_panda.learning.options import Args, default_args
from torch_panda.learning.training import Run


def make(env, relative_inputs="none"):
    return Normalizer(read_spaces(env), relative_inputs)


def test_relative_inputs_append_differences():
    with torch_panda.make("PandaStack-v1", num_envs=3, seed=0) as env:
        td = env.reset()
        observation, goal = td["observation"], td["desired_goal"]
        plain, coarse, fine = (
            make(env, relative_inputs)(observation, goal)
            for relative_inputs in ("none", "coarse", "fine")
        )
        differences = read_geometry(env).differences(observation, goal)
    torch.testing.assert_close(plain, torch.cat((observation, goal), -1))
    torch.testing.assert_close(coarse, torch.cat((plain, differences), -1))
    clipped = differences.clamp(-0.03, 0.03)
    assert 0 < (clipped != differences).sum() < differences.numel()
    torch.testing.assert_close(fine, torch.cat((coarse, clipped), -1))


def test_a_critic_of_a_part_sees_little_of_other_objects():
    with torch_panda.make("PandaStack-v1", num_envs=1) as env:
        first, second = make(env, "fine").part_weights()
        plain, _ = make(env).part_weights()
    # Each cube has 12 numbers, 3 of the goal, and two offsets, coarse and fine.
    goals_and_offsets = [1.0] * 3 + [0.1] * 3
    expected = [1.0] * 7 + [1.0] * 12 + [0.1] * 12 + goals_and_offsets * 5
    torch.testing.assert_close(first, torch.tensor(expected))
    torch.testing.assert_close(plain, first[:37])
    assert ((first == 0.1) != (second == 0.1)).sum() == 2 * (12 + 15)


def test_agents_see_the_offsets_that_their_options_name():
    """Reach has one offset, from the hand to the goal. It is an input twice, "fine"."""
    with torch_panda.make("PandaReach-v1", num_envs=3, seed=0) as env:
        td = env.reset()
        online = make_agent(env, Hyperparameters(relative_inputs="fine"))
        offline = make_agent(env, default_args("offline", "PandaReach-v1"))
    offset = td["desired_goal"] - td["observation"][:, :3]
    expected = torch.cat((offset, offset.clamp(-0.03, 0.03)), -1)
    for agent in (online, offline):
        seen = agent.normalizer(td["observation"], td["desired_goal"])
        torch.testing.assert_close(seen[:, 9:], expected)


@pytest.mark.parametrize(("relative_inputs", "shown"), [("none", 0.1), ("fine", 0.03)])
def test_fine_inputs_replace_the_height_of_slides_goals(relative_inputs, shown):
    with torch_panda.make("PandaSlide-v1", num_envs=3, seed=0) as env:
        td = env.reset()
        goal = td["desired_goal"].clone()
        goal[:, 2] = 0.1
        size = td["observation"].shape[-1] + 3
        seen = make(env, relative_inputs)(td["observation"], goal)[:, :size]
    torch.testing.assert_close(seen[:, -1], torch.full((3,), shown))
    assert (goal[:, 2] == 0.1).all()


@pytest.mark.parametrize("task", ["Reach", "Stack", "Flip"])
@pytest.mark.parametrize("relative_inputs", ["none", "coarse", "fine"])
def test_states_are_the_inputs_that_do_not_depend_on_the_goal(task, relative_inputs):
    with torch_panda.make(f"Panda{task}-v1", num_envs=3, seed=0) as env:
        td = env.reset()
        normalizer = make(env, relative_inputs)
        num_objects = len(read_geometry(env).positions) - 1
    observation, goal = td["observation"], td["desired_goal"]
    normalizer.mean.uniform_(-1, 1)
    seen = normalizer(observation, goal)
    one, other = normalizer(observation, goal), normalizer(observation, -goal.flip(-1))
    changed = (one != other).any(0)
    state = normalizer.state(observation)
    assert not changed[normalizer.state_columns].any()
    assert torch.equal(state, seen[:, normalizer.state_columns])
    # All offsets to objects are part of the state.
    parts = ("none", "coarse", "fine").index(relative_inputs)
    assert state.shape[-1] == observation.shape[-1] + 3 * num_objects * parts


def test_goals_are_normalised_alone():
    normalizer = Normalizer(SPACES, "none")
    normalizer.update(torch.randn(50, 5), 3 + 2 * torch.randn(50, 2))
    goal = torch.randn(4, 2)
    expected = normalizer(torch.zeros(4, 5), goal)[:, 5:]
    torch.testing.assert_close(normalizer.goal(goal), expected)
    with torch_panda.make("PandaFlip-v1", num_envs=1) as env:
        normalizer = make(env)
    normalizer.mean.fill_(0.3)
    orientation = torch.tensor([[0.5, 0.5, -0.5, 0.5]])
    assert torch.equal(normalizer.goal(orientation), orientation)


def test_inputs_are_normalised_by_their_statistics_and_clipped():
    normalizer = Normalizer(SPACES, "none")
    observation, goal = 3 + 2 * torch.randn(200, 5), torch.randn(200, 2)
    observation[:, 4] = 7.0
    for rows in range(0, 200, 50):
        part = slice(rows, rows + 50)
        normalizer.update(observation[part], goal[part])
    assert normalizer.count == 200
    inputs = torch.cat((observation, goal), -1)
    std = inputs.std(0, unbiased=False)
    std[4] = 0.01  # the smallest deviation, for inputs that hardly change
    torch.testing.assert_close(normalizer.mean, inputs.mean(0))
    torch.testing.assert_close(normalizer.std, std)
    expected = ((inputs - inputs.mean(0)) / std).clamp(-5, 5)
    seen = normalizer(observation, goal)
    torch.testing.assert_close(seen, expected, atol=1e-4, rtol=0)
    far = normalizer(observation + 100, goal)
    assert (far[:, :5] == 5).all()


def test_huge_inputs_count_as_200():
    normalizer = Normalizer(SPACES, "none")
    normalizer.update(torch.tensor([[1e6, -1e6, 0.0, 0.0, 0.0]]), torch.zeros(1, 2))
    assert normalizer.mean.tolist() == [200.0, -200.0, 0.0, 0.0, 0.0, 0.0, 0.0]


def test_the_statistics_of_a_training_include_hindsight_goals(tmp_path):
    """Four of five goals are achieved ones. The desired goals are far away here."""
    run = Run(Args(num_envs=4), tmp_path)
    data = play_randomly(run.env)
    for part in (data, data["next"]):
        part["desired_goal"] = torch.full_like(part["desired_goal"], 10.0)
    achieved = data["next", "achieved_goal"].mean((0, 1))
    run.source.store(data)
    run.close()
    normalizer = run.agent.normalizer
    assert normalizer.count == 4 * 50
    share = (normalizer.mean[-3:] - achieved) / (10.0 - achieved)  # of desired goals
    assert ((share > 0.1) & (share < 0.3)).all()
