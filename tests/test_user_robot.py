"""A user's robot with a gripper, written with public names only."""

import pytest
import torch
from torchrl.envs.utils import check_env_specs

import torch_panda
from torch_panda import Gripper, PickAndPlace, Reach, Robot, RobotTaskEnv
from torch_panda.bullet import PhysicsClient
from torch_panda.robots import Tool

FINGER = (
    '<collision><origin xyz="0 0 -0.05"/><geometry><box size="0.02 0.01 0.05"/>'
    "</geometry></collision>"
)


def link(name, parent, axis, low, high, *, kind="prismatic", mass=1.0, shape=""):
    return f"""
  <link name="{name}"><inertial><mass value="{mass}"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>
    {shape}</link>
  <joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{name}"/>
    <axis xyz="{axis}"/>
    <limit lower="{low}" upper="{high}" effort="500" velocity="5"/></joint>
"""


# A gantry: three slides, a turning hand, and two fingers.
GANTRY = (
    '<robot name="gantry"><link name="base"/>'
    + link("x", "base", "1 0 0", -0.5, 0.5)
    + link("y", "x", "0 1 0", -0.5, 0.5)
    + link("z", "y", "0 0 1", -0.5, 0.5)
    + link("hand", "z", "0 0 1", -3, 3, kind="revolute")
    + link("left", "hand", "0 1 0", 0.0, 0.04, mass=0.1, shape=FINGER)
    + link("right", "hand", "0 -1 0", 0.0, 0.04, mass=0.1, shape=FINGER)
    + "</robot>"
)


def make_gantry(file, ee_link=6, **options):
    return Robot(
        urdf=file,
        neutral_joint_position=(0.0,) * 6,
        effort_limits=(500.0, 500.0, 500.0, 50.0, 100.0, 100.0),
        ee_link=ee_link,
        ee_orientation=(0.0, 0.0, 0.0, 1.0),
        base_position=(0.0, 0.0, 0.3),
        gripper=Gripper(closed=(0.0, 0.0), opened=(0.04, 0.04), width=0.07),
        tool=Tool("hand", (0.0, 0.0, -0.065)),
        finger_links=(4, 5),
        **options,
    )


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "gantry.urdf"
    path.write_text(GANTRY)
    return path


def test_a_changed_urdf_is_read_again(file):
    def hand_position():
        with RobotTaskEnv(robot=make_gantry(file), task=Reach()) as env:
            return env.reset()["observation"][:3]

    before = hand_position()
    slide = '<axis xyz="1 0 0"/>'
    file.write_text(GANTRY.replace(slide, f'{slide}<origin xyz="0 0 0.1"/>'))
    change = (hand_position() - before).tolist()
    assert change == pytest.approx([0, 0, 0.1], abs=1e-3)


@pytest.mark.parametrize("control_type", ["ee", "ee_pose", "joints", "joint_velocity"])
def test_a_gantry_moves_under_each_control_type(file, control_type):
    robot = make_gantry(file, control_type=control_type, block_gripper=True)
    with RobotTaskEnv(robot=robot, task=Reach(), num_envs=2, seed=0) as env:
        check_env_specs(env)
        td = env.reset()
        start = td["achieved_goal"].clone()
        action = torch.zeros(env.action_spec.shape)
        action[..., 0] = 1.0
        for _ in range(5):
            td = env.step(td.set("action", action))["next"]
        moved = td["achieved_goal"] - start
        assert (moved[:, 0] > 0.05).all() and (moved[:, 1:].abs() < 0.01).all()


@pytest.mark.parametrize("control_type", ["ee", "ee_pose"])
def test_a_turned_centre_of_mass_stays_where_it_is(file, control_type):
    hand = '<link name="hand"><inertial>'
    assert hand in GANTRY
    frame = f'{hand}<origin xyz="0.03 0.01 0.05" rpy="0 0 0.7"/>'
    file.write_text(GANTRY.replace(hand, frame))
    robot = make_gantry(file, control_type=control_type, block_gripper=True, ee_link=3)
    with RobotTaskEnv(robot=robot, task=Reach()) as env:
        td = env.reset()
        simulation = env.episodes.simulation
        assert any(simulation.ee_frame[:6])
        position = simulation.ee_position.clone()
        orientation = simulation.ee_orientation.clone()
        if control_type == "ee":  # keeps the orientation of the robot's options
            orientation = orientation.new_tensor([robot.ee_orientation])
        for _ in range(30):
            td = env.step(td.set("action", torch.zeros(env.action_spec.shape)))["next"]
        torch.testing.assert_close(simulation.ee_position, position, atol=2e-3, rtol=0)
        torch.testing.assert_close(
            simulation.ee_orientation, orientation, atol=1e-3, rtol=0
        )


def pick_and_place(env, steps):
    """Move above the cube, then down, close the gripper, and move to the goal."""
    td = env.reset()
    for step in range(steps):
        hand, cube = td["observation"][:, :3], td["achieved_goal"]
        action = torch.zeros(env.action_spec.shape)
        action[:, -1] = 1.0 if step < 22 else -1.0
        if step < 12:
            above = torch.tensor((0.0, 0.0, 0.1))
            action[:, :3] = 10 * (cube + above - hand)
        elif step < 22:
            action[:, :3] = 10 * (cube - hand)
        elif step >= 30:
            action[:, :3] = 5 * (td["desired_goal"] - cube)
        td = env.step(td.set("action", action))["next"]
    return td


def test_a_tool_is_at_its_place_and_has_no_mass(file):
    robot = make_gantry(file)
    with RobotTaskEnv(robot=robot, task=Reach()) as env:
        position = env.reset()["achieved_goal"].tolist()
        assert position == pytest.approx([0.0, 0.0, 0.3 - 0.065])
        simulation = env.episodes.simulation
        body, client = simulation.scene.robot, simulation.clients[0]
        assert client.mass(body, robot.ee_link) == 0.0
        assert client.mass(body, robot.ee_link - 1) == 0.1


def test_a_gantry_grasps(file):
    robot, task = make_gantry(file), PickAndPlace()
    with RobotTaskEnv(
        robot=robot, task=task, num_envs=4, seed=0, max_episode_steps=70
    ) as env:
        assert env.reset()["observation"].shape == (4, 19)
        assert pick_and_place(env, 60)["success"].sum() >= 3


def test_the_xarm_grasps():
    with torch_panda.make(
        "XArm6GripperPickAndPlace-v1", num_envs=8, seed=0, max_episode_steps=80
    ) as env:
        assert pick_and_place(env, 60)["success"].sum() >= 7


@pytest.mark.parametrize("env_id", ["KukaReach-v1", "XArm6Reach-v1"])
def test_shipped_robots_reach(env_id):
    with torch_panda.make(env_id, num_envs=8, seed=0) as env:
        td = env.reset()
        for _ in range(45):
            error = td["desired_goal"] - td["achieved_goal"]
            td = env.step(td.set("action", error * 10))["next"]
        assert td["success"].all()


@pytest.mark.parametrize(("friction", "expected"), [(None, 0.5), (2.0, 2.0)])
def test_the_friction_of_the_fingers_is_that_of_the_robot(file, friction, expected):
    with PhysicsClient() as client:
        body = make_gantry(file, finger_friction=friction).build(client)
        assert [client.friction(body, link) for link in (3, 4, 5)] == [
            0.5,
            expected,
            expected,
        ]


def test_a_gripper_or_tool_that_does_not_fit_is_refused(file):
    with pytest.raises(ValueError, match="4 joints of the arm and 1 of the gripper"):
        Robot(
            urdf=file,
            neutral_joint_position=(0.0,) * 6,
            effort_limits=(1.0,) * 6,
            ee_link=3,
            num_arm_joints=4,
            gripper=Gripper(closed=(0.0,), opened=(0.04,), width=0.04),
        )
    robot = make_gantry(file)
    robot.tool = Tool("wrist", (0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="a tool must be fixed to one of"):
        RobotTaskEnv(robot=robot, task=Reach())
    file.write_text(GANTRY.replace("left", "tool"))
    with pytest.raises(ValueError, match="already has a link named 'tool'"):
        RobotTaskEnv(robot=make_gantry(file), task=Reach())
