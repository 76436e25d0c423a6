"""The page of numbers, and the tasks and robots of the ids -v1 and -v3."""

import ast
import re
from pathlib import Path

import pytest
import torch

import torch_panda
from tests.ids import PHYSICS_IDS
from torch_panda.bullet.shapes import BLUE, RED
from torch_panda.registry import find_registration

PAGE = Path(torch_panda.__file__).parent / "tasks" / "README.md"
COLORS = {"red": RED, "blue": BLUE}


def read_value(cell):
    code = re.match(r"`(.+?)`", cell)
    return ast.literal_eval(code[1]) if code else COLORS[cell]


def rows_of_the_page():
    """(task, argument): (value in -v1, value in -v3), of tasks and of robots."""
    row = r"^\| ([\w, ]+): `(\w+)`.*? \| (.+?) \| .+? \| (.+?) \|$"
    tables = PAGE.read_text().split("| argument of the robot |")
    return tuple(
        {
            (task, argument): (read_value(v1), read_value(v3))
            for tasks, argument, v1, v3 in re.findall(row, table, re.MULTILINE)
            for task in tasks.split(", ")
        }
        for table in tables
    )


def differences_in_the_code():
    """The same of the registered ids."""
    found = ({}, {})
    for env_id in PHYSICS_IDS:
        new = find_registration(env_id)
        if not env_id.endswith("-v3") or "Joints" in env_id:
            continue
        old = find_registration(env_id.replace("-v3", "-v1"))
        task_name = type(new.make_task()).__name__
        pairs = (
            (old.make_task(), new.make_task()),
            (old.make_robot(), new.make_robot()),
        )
        for differences, (first, second) in zip(found, pairs, strict=True):
            for name, value in vars(second).items():
                if not name.startswith("_") and value != vars(first)[name]:
                    differences[task_name, name] = (vars(first)[name], value)
    return found


def test_the_page_lists_all_arguments_that_differ():
    assert rows_of_the_page() == differences_in_the_code()


@pytest.mark.parametrize("version", ["v1", "v3"])
@pytest.mark.parametrize(
    ("task", "name", "value"),
    [
        ("Push", "object_friction", 0.5),
        ("Flip", "object_friction", 0.5),
        ("Flip", "object_mass", 1.0),
        ("Flip", "distance_threshold", 0.2),
        ("Reach", "distance_threshold", 0.05),
        ("Reach", "goal_range", 0.3),
        ("PickAndPlace", "goal_z_range", 0.2),
    ],
)
def test_both_versions_share_what_the_page_says(version, task, name, value):
    made = find_registration(f"Panda{task}-{version}").make_task()
    assert getattr(made, name) == value


@pytest.mark.parametrize("task", ["Reach", "Push", "Slide", "PickAndPlace", "Stack"])
def test_the_defaults_of_a_task_are_those_of_v1(task):
    made = find_registration(f"Panda{task}-v1").make_task()
    assert vars(made) == vars(type(made)())


def test_flip_has_the_fingers_of_panda_gym_3():
    for version in ("v1", "v3"):
        robot = find_registration(f"PandaFlip-{version}").make_robot()
        assert (robot.finger_friction, robot.finger_spinning_friction) == (1.0, 0.001)


# Friction brakes a sliding body by mu g, where mu is the product of both values.
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
def test_friction_brakes_sliding_objects_by_mu_g(env_id, friction):
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
        final_speed = td["observation"][index].item()
    expected = speed - friction * 9.81 * 0.04 * steps
    assert final_speed == pytest.approx(expected, abs=0.1 * (speed - expected))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"object_mass": -1.0}, "mass must be finite and at least 0, got -1.0"),
        ({"object_friction": float("nan")}, "lateral_friction must be finite"),
        ({"table_friction": -0.1}, "lateral_friction must be finite"),
    ],
)
def test_masses_and_frictions_out_of_range_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        torch_panda.RobotTaskEnv(
            robot=torch_panda.Panda(), task=torch_panda.Push(**arguments)
        )
