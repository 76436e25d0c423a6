"""Sizes, positions, ranges and other numbers are checked where they are given."""

import dataclasses
import inspect
import math

import gymnasium
import numpy as np
import pytest
import torch

import torch_panda
from tests.envs.test_checks import make_kuka
from torch_panda import Camera, Gripper, Panda, Push, tasks
from torch_panda.bullet import Box, Cylinder, PhysicsClient, Sphere
from torch_panda.rendering import HandCamera
from torch_panda.robots import XArm6Gripper
from torch_panda.tasks import create_table

NOT_NUMBERS = (math.nan, math.inf, -math.inf, "2", None)
NOT_NEGATIVE = (*NOT_NUMBERS, -0.1)
ABOVE_ZERO = (*NOT_NEGATIVE, 0.0)
REFUSED = (ValueError, TypeError)

TASKS = [
    task
    for task in vars(torch_panda).values()
    if inspect.isclass(task) and issubclass(task, tasks.Task) and task is not tasks.Task
]
POSITIVE = ("object_mass", "drawer_mass", "peg_mass", "table_length")
POSITIVE += ("clearance", "depth")


def wrong_values(name):
    if name in POSITIVE:
        return ABOVE_ZERO
    return NOT_NUMBERS if name.endswith("_offset") else NOT_NEGATIVE


@pytest.mark.parametrize("task", TASKS)
def test_a_task_refuses_wrong_numbers_by_name(task):
    numbers = [field.name for field in dataclasses.fields(task) if field.type is float]
    assert "table_friction" in numbers and "distance_threshold" in numbers
    for name in numbers:
        for value in wrong_values(name):
            with pytest.raises(REFUSED, match=f"^{name} must be"):
                task(**{name: value})


@pytest.mark.parametrize("masses", [2.0, (2.0,), (2.0, -1.0), (math.nan, 1.0), "22"])
def test_stack_needs_two_masses(masses):
    with pytest.raises(REFUSED, match=r"^object_mass must be"):
        tasks.Stack(object_mass=masses)


@pytest.mark.parametrize("number", [np.float32(0.2), np.int64(1), torch.tensor(0.2), 0])
def test_numbers_of_other_libraries_are_accepted(number):
    assert Push(goal_xy_range=number).goal_xy_range == number


@pytest.mark.parametrize(
    ("robot", "name", "values"),
    [
        (Panda, "action_scale", (math.nan, -0.1, 0.0, "0.1")),
        (Panda, "fingers_width", (*NOT_NEGATIVE, 0.1)),
        (Panda, "finger_friction", (math.nan, -0.1, "0.1")),
        (Panda, "finger_spinning_friction", (math.nan, -0.1, "0.1")),
        (XArm6Gripper, "finger_friction", (math.nan, -0.1, "0.1")),
        (Panda, "base_position", ((0, 0), (0, 0, math.nan), ("0", 0, 0), 0.0)),
        (Panda, "workspace", (((0, 0, math.nan), (1, 1, 1)), ((0, 0, 0), (1, 1)))),
    ],
)
def test_a_robot_refuses_wrong_numbers_by_name(robot, name, values):
    for value in values:
        with pytest.raises(REFUSED, match=f"^{name} must be"):
            robot(**{name: value})


def test_a_workspace_is_copied():
    corners = [[-0.1, -0.1, 0.0], [0.1, 0.1, 0.2]]
    robot = Panda(workspace=corners)
    corners[0][0] = -9.0
    assert robot.workspace == ((-0.1, -0.1, 0.0), (0.1, 0.1, 0.2))


@pytest.mark.parametrize("name", ["width", "scale", "closed", "opened"])
def test_a_gripper_refuses_wrong_numbers_by_name(name):
    good = {"closed": (0.0, 0.0), "opened": (0.04, 0.04), "width": 0.08}
    for number in (math.nan, math.inf, "2", None):
        value = number if name in ("width", "scale") else (0.0, number)
        with pytest.raises(REFUSED, match=f"^{name} must be"):
            Gripper(**{**good, name: value})


# ---- bodies --------------------------------------------------------------------


@pytest.fixture(scope="module")
def client():
    with PhysicsClient() as client:
        yield client


POINT = {"mass": 1.0, "position": (0.0, 0.0, 0.0)}
WRONG_POSITIONS = ((0, 0), (0, 0, math.nan), (math.inf, 0, 0), ("0", 0, 0), None)


@pytest.mark.parametrize("size", ABOVE_ZERO)
def test_sizes_of_bodies_are_refused_by_name(client, size):
    with pytest.raises(REFUSED, match="half_extents must be"):
        client.create_box((0.1, size, 0.1), **POINT)
    with pytest.raises(REFUSED, match="radius must be"):
        client.create_cylinder(size, 0.1, **POINT)
    with pytest.raises(REFUSED, match="height must be"):
        client.create_cylinder(0.1, size, **POINT)
    with pytest.raises(REFUSED, match="radius must be"):
        client.create_sphere(size, **POINT)
    for shape in (Box((0.1, 0.1, size)), Cylinder(0.1, size), Sphere(size)):
        with pytest.raises(REFUSED, match=r"(half_extents|height|radius) must be"):
            client.create_marker((0, 0, 0), shape)
    with pytest.raises(REFUSED, match="length must be"):
        create_table(client, length=size)
    assert client.bodies == ()


@pytest.mark.parametrize("position", WRONG_POSITIONS)
def test_positions_of_bodies_are_refused_by_name(client, position):
    builders = [
        lambda: client.create_box((0.1, 0.1, 0.1), mass=1.0, position=position),
        lambda: client.create_cylinder(0.1, 0.1, mass=1.0, position=position),
        lambda: client.create_sphere(0.1, mass=1.0, position=position),
        lambda: client.create_marker(position, Sphere(0.1)),
        lambda: client.load_urdf("plane.urdf", position=position),
        lambda: client.set_base(0, position),
    ]
    for build in builders:
        with pytest.raises(ValueError, match="position must be three finite numbers"):
            build()
    assert client.bodies == ()


@pytest.mark.parametrize("mass", [*NOT_NUMBERS, -1.0])
def test_a_wrong_mass_is_refused_by_name(client, mass):
    with pytest.raises(REFUSED, match="mass must be"):
        client.create_sphere(0.1, mass=mass, position=(0, 0, 0))


def test_the_offset_of_a_table_is_refused_by_name(client):
    for offset in NOT_NUMBERS:
        with pytest.raises(REFUSED, match="x_offset must be"):
            create_table(client, x_offset=offset)


def test_the_position_of_a_tool_is_refused_by_name():
    tool = torch_panda.robots.Tool("lbr_iiwa_link_7", (0.0, 0.0, math.nan))
    with pytest.raises(ValueError, match="the position of a tool must be three finite"):
        torch_panda.RobotTaskEnv(robot=make_kuka(tool=tool), task=torch_panda.Reach())


# ---- cameras -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "values"),
    [
        *((name, NOT_NUMBERS) for name in ("yaw", "pitch", "roll")),
        *((name, ABOVE_ZERO) for name in ("distance", "fov", "near", "far")),
        ("fov", (180.0,)),
        ("near", (100.0,)),
        ("target", WRONG_POSITIONS),
        *((name, (0, -1, 64.5, "64", None)) for name in ("width", "height")),
    ],
)
def test_a_camera_refuses_wrong_numbers_by_name(name, values):
    for value in values:
        with pytest.raises(REFUSED, match=f"^{name} must be"):
            Camera(**{name: value})


@pytest.mark.parametrize("name", ["eye", "target", "up"])
def test_a_camera_on_the_hand_refuses_wrong_numbers_by_name(name):
    with pytest.raises(ValueError, match=f"^{name} must be three finite numbers"):
        HandCamera(**{name: (0, 0, math.nan)})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("render_target_position", (0.0, 0.0)),
        ("render_target_position", (0.0, 0.0, math.nan)),
        ("render_distance", 0.0),
        ("render_yaw", math.nan),
        ("render_width", 0),
    ],
)
def test_a_camera_argument_of_panda_gym_is_refused(name, value):
    field = name.removeprefix("render_").removesuffix("_position")
    with pytest.raises(ValueError, match=f"{field}.* must be"):
        gymnasium.make("torch_panda/PandaReach-v3", **{name: value})
