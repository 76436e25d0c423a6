"""Inputs of the networks."""

import pytest
import torch

import torch_panda
from torch_panda.learning.geometry import read_geometry
from torch_panda.learning.normalizer import CLIP_NORMALIZED, FINE_LIMIT, Normalizer
from torch_panda.learning.spaces import read_spaces


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
    clipped = differences.clamp(-FINE_LIMIT, FINE_LIMIT)
    assert 0 < (clipped != differences).sum() < differences.numel()
    torch.testing.assert_close(fine, torch.cat((coarse, clipped), -1))


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


def test_inputs_are_normalised_by_their_statistics_and_clipped():
    with torch_panda.make("PandaReach-v1", num_envs=1) as env:
        normalizer = make(env)
    observation, goal = 3 + 2 * torch.randn(200, 6), torch.randn(200, 3)
    for rows in range(0, 200, 50):
        part = slice(rows, rows + 50)
        normalizer.update(observation[part], goal[part])
    assert normalizer.count == 200
    inputs = torch.cat((observation, goal), -1)
    torch.testing.assert_close(normalizer.mean, inputs.mean(0))
    torch.testing.assert_close(normalizer.std, inputs.std(0, unbiased=False))
    seen = normalizer(observation, goal)
    torch.testing.assert_close(seen.mean(0), torch.zeros(9), atol=1e-5, rtol=0)
    far = normalizer(observation + 100, goal)
    assert (far[:, :6] == CLIP_NORMALIZED).all()
