"""Options survive Gymnasium's JSON of a specification, with which Minari makes envs."""

from fractions import Fraction

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode

import torch_panda
from torch_panda import Camera, CameraSensor, HandCamera, PhysicsParams, Randomization
from torch_panda.sensors.joints import JointState

pytestmark = pytest.mark.filterwarnings("ignore:.*out of date")

ID = "torch_panda/PandaPush-v1"
SMALL = Camera(target=(0.1, 0.0, 0.05), yaw=10.0, width=12, height=8)
HAND = HandCamera(eye=(0.09, 0.0, -0.1), width=12, height=8)
RANDOMIZE = Randomization(object_mass=(0.5, 2.0), joint_position=0.1, observe=True)


def remake(env, **options):
    """The environment that Gymnasium makes of the JSON of another one."""
    spec = EnvSpec.from_json(env.spec.to_json())
    env.close()
    return gymnasium.make(spec, **options)


@pytest.mark.parametrize("camera", [SMALL, HAND])
def test_cameras_are_the_same_after_a_round_trip(camera):
    options = {"render_mode": "rgb_array", "render_camera": camera}
    env = gymnasium.make(ID, from_pixels=True, camera=camera, **options)
    start, _ = env.reset(seed=1)
    picture = env.render()
    again = remake(env)
    start_again, _ = again.reset(seed=1)
    np.testing.assert_array_equal(start_again["pixels"], start["pixels"])
    np.testing.assert_array_equal(again.render(), picture)
    again.close()


@pytest.mark.parametrize(
    "options",
    [
        {"physics": PhysicsParams(n_substeps=4, gravity=-1.0)},
        {"physics": "fast"},
        {"randomize": RANDOMIZE},
        {"sensors": ("joint_state", "finger_contact")},
        # The types of arrays, devices and tuples are lost, but not their values.
        {"seed": np.int64(3), "task_options": {"distance_threshold": np.float32(0.25)}},
        {
            "task_options": {"obj_xy_range": np.array(0.1)},
            "device": torch.device("cpu"),
        },
        {
            "robot_options": {
                "base_position": (-0.5, 0.0, 0.0),
                "workspace": np.array([[-0.3, -0.3, 0.0], [0.3, 0.3, 0.5]]),
            }
        },
        {"depth": True, "render_size": (np.int32(6), 8)},
        {"render_mode": "rgb_array", "render_target_position": np.zeros(3)},
    ],
)
def test_an_episode_is_the_same_after_a_round_trip(options):
    def play(env):
        states = [env.reset(seed=1)[0]]
        states += [env.step(np.ones(env.action_space.shape))[0] for _ in range(3)]
        return states, env.unwrapped.torch_env.get_state()

    env = gymnasium.make(ID, **options)
    states, state = play(env)
    again = remake(env)
    states_again, state_again = play(again)
    again.close()
    for before, after in zip(states, states_again, strict=True):
        assert before.keys() == after.keys()
        for key in before:
            np.testing.assert_array_equal(before[key], after[key])
    assert (state == state_again).all()


def test_vector_environments_make_a_round_trip():
    options = {"physics": PhysicsParams(n_substeps=4), "render_camera": SMALL}
    mode = AutoresetMode.DISABLED
    env = gymnasium.make_vec(ID, num_envs=2, autoreset_mode=mode, **options)
    spec = EnvSpec.from_json(env.spec.to_json())
    env.close()
    again = gymnasium.make_vec(spec)
    assert again.num_envs == 2
    assert again.unwrapped.torch_env.physics == options["physics"]
    assert again.unwrapped.autoreset_mode is mode
    again.close()


@pytest.mark.parametrize("sensor", [CameraSensor(SMALL), JointState()])
def test_sensor_objects_cannot_be_written_as_json(sensor):
    env = gymnasium.make(ID, sensors=(sensor,))
    with pytest.raises(ValueError, match=r"^sensors of .*: give sensors by name"):
        env.spec.to_json()
    env.close()


def test_other_objects_cannot_be_written_as_json():
    env = gymnasium.make(ID, task_options={"goal_xy_range": Fraction(1, 4)})
    with pytest.raises(ValueError, match=r"^task_options of .* cannot be written as"):
        env.spec.to_json()
    env.close()


def test_a_specification_equals_itself_after_a_round_trip():
    env = gymnasium.make(ID)
    spec = env.spec
    env.close()
    assert EnvSpec.from_json(spec.to_json()) == spec
    assert spec != gymnasium.spec("torch_panda/PandaPush-v3")


def test_ids_of_users_make_a_round_trip():
    torch_panda.register("Nudge-v0", robot=torch_panda.Panda, task=torch_panda.Push)
    env = gymnasium.make(
        "torch_panda/Nudge-v0",
        physics=PhysicsParams(n_substeps=4),
        task_options={"distance_threshold": 0.01},
    )
    again = remake(env)
    assert again.unwrapped.torch_env.physics.n_substeps == 4
    assert again.unwrapped.torch_env.task.distance_threshold == 0.01
    again.close()
