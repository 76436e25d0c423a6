"""Render modes, and the camera arguments of panda-gym."""

import gymnasium
import numpy as np
import panda_gym  # noqa: F401 (registers its environments)
import pytest

import torch_panda
from torch_panda import Camera
from torch_panda.gymnasium_envs import GoalEnv, GoalVectorEnv
from torch_panda.gymnasium_envs.sb3 import SB3VecEnv

VIEW = {
    "render_width": 60,
    "render_height": 40,
    "render_target_position": [0.1, 0.0, 0.05],
    "render_distance": 0.9,
    "render_yaw": 20,
    "render_pitch": -50,
    "render_roll": 5,
}


@pytest.mark.parametrize("substeps", [20, 10])
def test_videos_are_as_fast_as_the_simulation(substeps):
    physics = torch_panda.PhysicsParams(n_substeps=substeps)
    for env_class in (GoalEnv, GoalVectorEnv, SB3VecEnv):
        env = env_class("PandaReach-v1", physics=physics, render_mode="rgb_array")
        env.close()
        assert env.metadata["render_fps"] == 500 / substeps
        assert env.metadata["render_modes"] == ["rgb_array"]
    assert GoalEnv.metadata["render_fps"] == 25


def test_the_camera_arguments_of_panda_gym_give_its_view():
    """Outside the translucent target, the pixels equal panda-gym's."""
    ours = gymnasium.make("torch_panda/PandaReach-v3", render_mode="rgb_array", **VIEW)
    theirs = gymnasium.make(
        "PandaReach-v3", render_mode="rgb_array", renderer="Tiny", **VIEW
    )
    ours.reset(seed=0)
    theirs.reset(seed=0)
    a, b = ours.render(), theirs.render()
    ours.close()
    theirs.close()
    assert a.shape == b.shape == (40, 60, 3)
    # Goals differ: so do the pixels of both targets.
    assert (a != b).any(axis=-1).mean() < 0.05


def test_a_given_camera_is_used_and_a_width_changes_it():
    camera = Camera(distance=0.6, width=30, height=20)
    single = GoalEnv("PandaReach-v1", render_mode="rgb_array", render_camera=camera)
    many = GoalVectorEnv(
        "PandaReach-v1",
        num_envs=2,
        render_mode="rgb_array",
        render_camera=camera,
        render_width=40,
    )
    single.reset(seed=0)
    many.reset(seed=0)
    pixels = single.render()
    assert np.array_equal(pixels, single.torch_env.render(camera=camera))
    frames = many.render()
    assert [frame.shape for frame in frames] == [(20, 40, 3)] * 2
    single.close()
    many.close()
