"""Actions under each control type, grippers, workspaces and bases."""

import math
from itertools import product
from typing import get_args

import pybullet
import pybullet_data
import pytest
import torch
from pybullet_utils.bullet_client import BulletClient
from torchrl.envs.utils import check_env_specs

import torch_panda
from torch_panda import (
    Gripper,
    Kuka,
    Panda,
    Reach,
    RobotTaskEnv,
    XArm6,
    XArm6Gripper,
)
from torch_panda.robots import ControlType
from torch_panda.rotations import (
    quaternion_product,
    rotation_vector_to_quaternion,
)

TYPES = get_args(ControlType)
ID = "PandaPickAndPlace-v1"
DIMS = {"ee": 3, "ee_pose": 6, "joints": 7, "joint_velocity": 7, "joint_torque": 7}
SETTLED = 8  # steps until the arm moves steadily


def make(env_id=ID, *, num_envs=1, **options):
    return torch_panda.make(env_id, num_envs=num_envs, seed=0, robot_options=options)


def hold(env, action, steps=SETTLED):
    """Repeat an action, and return the simulation and the last output."""
    td = env.reset()
    for _ in range(steps):
        td = env.step(td.set("action", action.expand(env.action_spec.shape)))["next"]
    return env.episodes.simulation, td


def unit(size, index, value=1.0):
    action = torch.zeros(size)
    action[index] = value
    return action


@pytest.mark.parametrize("control_type", TYPES)
def test_the_control_type_determines_the_size_of_actions(control_type):
    with make(control_type=control_type) as env:
        check_env_specs(env)
        assert env.action_spec.shape == (1, DIMS[control_type] + 1)
    with make("PandaPush-v1", control_type=control_type) as env:
        assert env.action_spec.shape == (1, DIMS[control_type])


def test_the_default_scales_of_actions_are_the_published_ones():
    """5 cm, 0.05 rad, 1.25 rad/s, and the whole torque."""
    scales = [Panda(control_type=name).action_scale for name in DIMS]
    assert scales == [0.05, 0.05, 0.05, 1.25, 1.0]


def test_an_action_displaces_the_setpoint_by_its_scale():
    for control_type, size in (("ee", 3), ("joints", 7)):
        action = torch.linspace(0.6, -0.8, size + 1).unsqueeze(0)
        with make(control_type=control_type) as env:
            env.reset()
            simulation = env.episodes.simulation
            present = simulation.ee_position
            if control_type == "joints":
                present = simulation.joint_position[:, :7]
            setpoint = env.robot.setpoint(action, simulation)
            moved = setpoint[:, :size] - present
            torch.testing.assert_close(moved.float(), 0.05 * action[:, :size])
            # The fingers are closed, and stay so under a negative number: below 0.
            expected = torch.full((1, 2), -0.8 * 0.2 / 2, dtype=torch.float64)
            fingers = setpoint[:, size:]
            torch.testing.assert_close(fingers, expected, atol=1e-6, rtol=0)


def test_a_joint_moves_at_the_velocity_of_the_action():
    with make(control_type="joint_velocity") as env:
        simulation, _ = hold(env, unit(8, 3, 0.4))
        assert simulation.joint_velocity[0, 3] == pytest.approx(0.5, abs=0.02)
        others = simulation.joint_velocity[0, [0, 1, 2, 4, 5, 6]]
        assert others.abs().max() < 0.02
    with make(control_type="joint_velocity", action_scale=0.2) as env:
        simulation, _ = hold(env, unit(8, 3))
        assert simulation.joint_velocity[0, 3] == pytest.approx(0.2, abs=0.02)


def test_torques_move_the_arm_as_in_pybullet():
    with make("PandaReach-v1", control_type="joint_torque", action_scale=0.1) as env:
        action = torch.tensor([0.3, -0.2, 0.1, 0.4, 0.0, -0.5, 0.2])
        simulation, _ = hold(env, action, steps=3)
        found = simulation.joint_position[0, :7].tolist()
        torques = action * 0.1 * torch.tensor(env.robot.effort_limits[:7])
        start = env.robot.neutral_joint_position
    reference = BulletClient(pybullet.DIRECT)
    reference.setAdditionalSearchPath(pybullet_data.getDataPath())
    reference.setTimeStep(1 / 500)
    reference.setGravity(0, 0, -9.81)
    body = reference.loadURDF("franka_panda/panda.urdf", useFixedBase=True)
    joints = [0, 1, 2, 3, 4, 5, 6, 9, 10]
    for joint, position in zip(joints, start, strict=True):
        reference.resetJointState(body, joint, position)
    reference.setJointMotorControlArray(
        body, joints, pybullet.VELOCITY_CONTROL, forces=[0.0] * 7 + [170.0] * 2
    )
    for _ in range(60):
        reference.setJointMotorControlArray(
            body, joints[:7], pybullet.TORQUE_CONTROL, forces=torques.double().tolist()
        )
        reference.stepSimulation()
    expected = [reference.getJointState(body, joint)[0] for joint in joints[:7]]
    reference.disconnect()
    assert found == pytest.approx(expected, abs=1e-3)
    moved = torch.tensor(found) - torch.tensor(start[:7])
    assert moved.abs().max() > 0.02


def test_ee_pose_moves_along_the_world_and_rotates_in_the_hand_frame():
    start = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    with make(control_type="ee_pose") as env:
        simulation, td = hold(env, torch.zeros(7))
        rest = td["observation"][0, :3]
        _, td = hold(env, unit(7, 2, 0.5))
        up = td["observation"][0, :3] - rest
        assert up[2] > 0.1 and up[:2].abs().max() < 0.03
        for axis, angle in product(range(3), (0.5, -0.5)):
            simulation, td = hold(env, unit(7, 3 + axis, angle))
            assert (td["observation"][0, :3] - rest).norm() < 0.04
            vector = torch.zeros(1, 3, dtype=torch.float64)
            # The hand lags behind its setpoint.
            vector[0, axis] = SETTLED * angle * 0.05
            target = quaternion_product(start, rotation_vector_to_quaternion(vector))
            cosine = (simulation.ee_orientation * target).sum().abs()
            cosine_at_start = (start * target).sum().abs()
            assert cosine.acos() < 0.6 * cosine_at_start.acos()


@pytest.mark.parametrize("control_type", ["ee", "ee_pose"])
@pytest.mark.parametrize("arm", ["Panda", "Kuka", "XArm6", "XArm6Gripper"])
def test_the_hand_stays_where_it_is_without_an_action(arm, control_type):
    """Also if its centre of mass is not at the origin of its link, as in the Kuka."""
    with make(f"{arm}Reach-v1", control_type=control_type) as env:
        start = env.reset()["achieved_goal"]
        _, td = hold(env, torch.zeros(env.action_spec.shape), 50)
        assert (td["achieved_goal"] - start).norm() < 0.002


def test_rotations_agree_with_pybullet():
    torch.manual_seed(0)
    vectors = torch.randn(20, 3, dtype=torch.float64)
    turns = rotation_vector_to_quaternion(vectors)
    for vector, turn in zip(vectors, turns, strict=True):
        expected = pybullet.getQuaternionFromAxisAngle(
            vector.tolist(), vector.norm().item()
        )
        assert turn.tolist() == pytest.approx(expected)
    zero = rotation_vector_to_quaternion(torch.zeros(3, dtype=torch.float64))
    assert zero.tolist() == [0, 0, 0, 1]
    first, second = turns[:10], turns[10:]
    for a, b, found in zip(
        first, second, quaternion_product(first, second), strict=True
    ):
        _, expected = pybullet.multiplyTransforms(
            (0, 0, 0), a.tolist(), (0, 0, 0), b.tolist()
        )
        sign = math.copysign(1.0, found[3] * expected[3])  # q and -q are one rotation
        assert (sign * found).tolist() == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("control_type", ["ee", "ee_pose"])
def test_the_hand_stays_in_the_workspace(control_type):
    box = torch.tensor([[-0.1, -0.05, 0.15], [0.1, 0.05, 0.25]])
    workspace = box.double().numpy()
    with make(control_type=control_type, workspace=workspace) as env:
        workspace[:] = 0.0  # the robot has a copy
        for direction, corner in zip((-1.0, 1.0), box, strict=True):
            action = torch.zeros(env.action_spec.shape)
            action[:, :3] = direction
            _, td = hold(env, action, 20)
            error = td["observation"][0, :3] - corner
            assert error.abs().max() < 0.02  # it gets there, and no farther


def test_a_robot_on_a_turned_base_moves_in_the_turned_directions():
    half = math.sqrt(0.5)
    turned = {"base_position": (0.0, -0.6, 0.0), "base_orientation": (0, 0, half, half)}
    with make("PandaReach-v1", control_type="joints") as plain:
        _, first = hold(plain, torch.full((7,), 0.3))
    with make("PandaReach-v1", control_type="joints", **turned) as env:
        _, second = hold(env, torch.full((7,), 0.3))
    x, y, z = first["observation"][0, :3].tolist()
    found = second["observation"][0, :3].tolist()
    assert found == pytest.approx((-y, x, z), abs=1e-3)
    # Inverse kinematics accounts for the pose of the base.
    with make("PandaReach-v1", **turned) as env:
        td = env.reset()
        for _ in range(30):
            error = td["desired_goal"] - td["achieved_goal"]
            td = env.step(td.set("action", error * 10))["next"]
        assert td["success"].all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"control_type": "force"}, "control_type must be one of"),
        ({"action_scale": 0.0}, "action_scale must be finite and above 0"),
        ({"workspace": ((0, 0, 1), (0, 0, 0))}, "workspace must be"),
        ({"base_orientation": (0, 0, 0, 0)}, "base_orientation must be"),
    ],
)
def test_robot_options_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        Panda(**options)


def test_grippers_that_cannot_move_are_refused():
    with pytest.raises(ValueError, match="differ in at least one position"):
        Gripper(closed=(0.0,), opened=(0.0,), width=0.1)
    with pytest.raises(ValueError, match="width must be finite and above 0"):
        Gripper(closed=(0.0,), opened=(0.1,), width=0.0)


def test_a_gripper_changes_the_distance_between_its_fingers():
    """By 20 cm for an action of 1; at 4 cm, and an action of 0.1, to 6 cm."""
    gripper = Panda().gripper
    joints = torch.tensor([[0.025, 0.015]], dtype=torch.float64)
    width = gripper.fingers_width(joints)
    torch.testing.assert_close(width, torch.tensor([[0.04]], dtype=torch.float64))
    setpoint = gripper.setpoint(torch.tensor([[0.1]]), joints)
    assert setpoint[0].tolist() == pytest.approx([0.03, 0.03], abs=1e-7)


def test_fingers_that_follow_match_the_joint_that_leads():
    gripper = Gripper(
        closed=(0.8, 0.8), opened=(0.0, 0.0), width=0.1, mimic_joints=(1,)
    )
    joints = torch.tensor([[0.4, 0.7]], dtype=torch.float64)  # the second one lags
    assert gripper.fingers_width(joints).item() == pytest.approx(0.05)
    setpoint = gripper.setpoint(torch.tensor([[0.1]]), joints)
    # The first joint leads to a width of 7 cm. The second goes to the present 5 cm.
    assert setpoint[0].tolist() == pytest.approx([0.24, 0.4], abs=1e-6)


@pytest.mark.parametrize("joints", [(2,), (0, 1)])
def test_joints_that_cannot_mimic_another_are_refused(joints):
    message = r"mimic_joints must be indices below 2 and leave out one joint"
    with pytest.raises(ValueError, match=message):
        Gripper((0.8, 0.8), (0.0, 0.0), width=0.1, mimic_joints=joints)


def test_fingers_open_as_wide_as_the_gripper_allows():
    with RobotTaskEnv(robot=Panda(), task=Reach(), num_envs=1) as env:
        simulation, td = hold(env, unit(4, 3))
        assert td["observation"][0, 6] == pytest.approx(0.08, abs=0.001)
        assert simulation.joint_position[0, 7:].sum().item() == pytest.approx(0.08)


@pytest.mark.parametrize("robot_class", [Panda, Kuka, XArm6, XArm6Gripper])
def test_an_unknown_robot_argument_is_named_with_a_similar_one(robot_class):
    message = f"^{robot_class.__name__} .*'control'; did you mean 'control_type'"
    with pytest.raises(TypeError, match=message):
        robot_class(control="joints")
