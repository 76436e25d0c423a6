"""The table of both versions, and what it makes."""

import inspect

import pytest
import torch

import torch_panda
from torch_panda.versions import ROBOT_ARGUMENTS, TASK_ARGUMENTS, arguments_of

TASKS = list(TASK_ARGUMENTS)


def default(function, name):
    return inspect.signature(function).parameters[name].default


@pytest.mark.parametrize("task", TASKS)
def test_the_defaults_are_those_of_v1(task):
    task_class = getattr(torch_panda, task)
    for name, (v1, _) in TASK_ARGUMENTS[task].items():
        assert default(task_class, name) == v1, name


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("version", ["v1", "v3"])
def test_ids_have_their_version_of_every_argument(task, version):
    with torch_panda.make(f"Panda{task}-{version}") as env:
        for pairs, made in (
            (TASK_ARGUMENTS[task], env.task),
            (ROBOT_ARGUMENTS[task], env.robot),
        ):
            for name, value in arguments_of(pairs, version).items():
                assert getattr(made, name) == value, name


# How fast a body is after sliding for a while: friction brakes it by mu g.
@pytest.mark.parametrize(
    ("env_id", "friction"),
    [
        ("PandaPush-v1", 0.5 * 0.1),
        ("PandaPush-v3", 0.5 * 0.5),
        ("PandaPickAndPlace-v1", 5.0 * 0.1),
        ("PandaSlide-v1", 0.5 * 0.1),
        ("PandaSlide-v3", 0.04 * 0.5),
    ],
)
def test_objects_slide_as_far_as_their_friction_lets_them(env_id, friction):
    speed = 0.3
    with torch_panda.make(env_id) as env:
        state = env.reset().update(env.get_state())
        height = 0.015 if "Slide" in env_id else 0.02
        state["object_pose"][..., :3] = torch.tensor([0.0, 0.1, height])
        state["object_velocity"][..., 1] = speed
        td = env.reset(state, set_state=True)
        steps = int(0.8 * speed / (friction * 9.81) / 0.04)
        steps = min(steps, env.max_episode_steps)
        for _ in range(steps):
            td = env.step(td.set("action", env.action_spec.zero()))["next"]
        index = env.robot.observation_dim + 7
        left = td["observation"][index].item()
    expected = speed - friction * 9.81 * 0.04 * steps
    assert left == pytest.approx(expected, abs=0.1 * (speed - expected))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"object_mass": -1.0}, "mass must be finite and at least 0, got -1.0"),
        ({"object_friction": float("nan")}, "lateral_friction must be finite"),
        ({"table_friction": -0.1}, "lateral_friction must be finite"),
    ],
)
def test_impossible_constants(arguments, message):
    with pytest.raises(ValueError, match=message):
        torch_panda.RobotTaskEnv(
            robot=torch_panda.Panda(), task=torch_panda.Push(**arguments)
        )
