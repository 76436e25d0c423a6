"""Registrations of ids, and the arguments of `make`."""

import pytest

import torch_panda
from torch_panda import Panda, Push
from torch_panda.learning.environments import is_from_gymnasium
from torch_panda.registry import Family


class PushBall(Push):
    """A task of a user."""

    max_episode_steps = 30


@pytest.fixture
def env_id():
    torch_panda.register(
        "Unversioned", robot=lambda: Panda(control_type="joints"), task=PushBall
    )
    return "Unversioned"


def test_one_line_registers_all_ids_of_a_task():
    family = Family(Panda, PushBall, {"block_gripper": True})
    made = {
        registration.env_id: (registration.make_robot(), registration.make_task())
        for registration in family.registrations()
    }
    assert list(made) == [
        "PandaPushBall-v1",
        "PandaPushBallDense-v1",
        "PandaPushBallJoints-v1",
        "PandaPushBallJointsDense-v1",
    ]
    for robot, task in made.values():
        assert robot.block_gripper
        assert type(task) is PushBall
    robot, task = made["PandaPushBallJointsDense-v1"]
    assert (robot.control_type, task.reward_type) == ("joints", "dense")


def test_a_family_with_changes_for_v3_has_ids_of_both_versions():
    family = Family(
        Panda,
        PushBall,
        v3_task={"distance_threshold": 0.1},
        v3_robot={"finger_friction": 2.0},
        joints=False,
    )
    first, second, *dense = family.registrations()
    assert first.env_id == "PandaPushBall-v1"
    assert second.env_id == "PandaPushBall-v3"
    assert len(dense) == 2
    assert (first.terminate_on_success, second.terminate_on_success) == (False, True)
    assert second.max_episode_steps == PushBall.max_episode_steps
    assert second.make_task().distance_threshold == 0.1
    assert second.make_robot().finger_friction == 2.0
    assert first.make_task().distance_threshold == 0.05


@pytest.mark.parametrize(
    ("option", "value", "advice"),
    [
        ("n_envs", 4, "use num_envs;"),
        (
            "reward_type",
            "dense",
            r"use task_options=\{'reward_type': 'dense'\}, or the id PandaPushDense-v1",
        ),
        ("control_type", "joints", r"use robot_options=\{'control_type': 'joints'\}"),
        ("distance_threshold", 0.02, r"use task_options=\{'distance_threshold': 0.02"),
        ("render_mode", "human", r"use env.render\(\) .*, or env.open_viewer\(\)"),
        ("robot", Panda(), r"use an id, or RobotTaskEnv\(robot=..., task"),
        ("num_env", 3, "did you mean 'num_envs'"),
        ("max_steps", 3, "did you mean 'max_episode_steps'"),
        ("colour", "red", "accepted are env_id, .*num_envs, .*max_episode_steps"),
    ],
)
def test_make_says_what_to_use_for_an_unknown_argument(option, value, advice):
    message = rf"make got an unexpected keyword argument '{option}'; {advice}"
    with pytest.raises(TypeError, match=message):
        torch_panda.make("PandaPush-v1", **{option: value})


@pytest.mark.parametrize("from_pixels", [False, True])
def test_make_refuses_a_sensor_without_a_sequence(from_pixels):
    with pytest.raises(TypeError, match=r"tuple or list of names .*got 'joint_state'"):
        torch_panda.make("PandaPush-v1", sensors="joint_state", from_pixels=from_pixels)


def test_make_says_what_to_use_with_an_id_of_a_user(env_id):
    with pytest.raises(TypeError, match=r"use task_options=\{'reward_type': 'dense'}"):
        torch_panda.make(env_id, reward_type="dense")


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"env_id": "PandaPush-v1"}, ValueError, "ships; choose another one"),
        ({"env_id": "Two words"}, ValueError, "cannot be an id"),
        ({"max_episode_steps": 0}, ValueError, "max_episode_steps must be"),
        ({"robot": Panda()}, TypeError, "robot must be a class or a function"),
        (
            {"task": Push(), "max_episode_steps": 9},
            TypeError,
            "task must be a class or a function",
        ),
    ],
)
def test_wrong_registrations_are_refused(arguments, error, message):
    accepted = {"env_id": "Shove-v0", "robot": Panda, "task": Push}
    with pytest.raises(error, match=message):
        torch_panda.register(**(accepted | arguments))


def test_an_unknown_id_is_named_with_a_similar_one_and_the_accepted_ones(env_id):
    message = (
        r"'PandaPsh-v1'; did you mean 'PandaPush-v1'.*accepted ids are Panda\{Reach,.*"
        "registered ids are .*Unversioned.*import the module"
    )
    with pytest.raises(ValueError, match=message):
        torch_panda.make("PandaPsh-v1")
    for unknown in (None, ["PandaPush-v1"]):
        with pytest.raises(ValueError, match="unknown environment id"):
            torch_panda.make(unknown)
    assert torch_panda.max_episode_steps(env_id) == 30


@pytest.mark.parametrize("function", [torch_panda.make, is_from_gymnasium])
def test_the_id_of_gymnasium_is_answered_with_ours(function):
    message = "'torch_panda/PandaPush-v1' is the id in .*: use 'PandaPush-v1' here$"
    with pytest.raises(ValueError, match=message):
        function("torch_panda/PandaPush-v1")
