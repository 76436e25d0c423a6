"""Force sensors against Newton's laws: press the table, lift a cube."""

import pybullet
import pytest
import torch
from torchrl.envs.utils import check_env_specs

import torch_panda
from tests.envs.test_checks import make_kuka
from tests.pushing import pusher
from torch_panda import Reach, RobotTaskEnv
from torch_panda.bullet.pool import WorkerError
from torch_panda.bullet.urdf import find_urdf
from torch_panda.rotations import rotate
from torch_panda.sensors import JointTorque

SENSORS = ("wrist_force_torque", "finger_contact", "joint_torque")
G = 9.81  # [m/s^2]
MOUNT, HAND = 7, 8  # links
PARTS = {HAND: 0.81, 9: 0.1, 10: 0.1}  # masses of hand and fingers in the URDF [kg]
HAND_MASS = sum(PARTS.values())
FINGERS = (9, 10)  # links
ARM = 7  # joints


def force_on_hand(env, td):
    """The measured force [N] along the world's axes; the sensor's are the hand's."""
    simulation = env.episodes.simulation
    state = simulation.clients[0].state(simulation.scene.robot)
    rotation = torch.tensor(state.link_pose(HAND)[3:].tolist())
    return rotate(rotation, td["wrist_force_torque"][:3])


def test_forces_balance_when_the_hand_presses_the_table():
    with torch_panda.make("PandaPush-v1", seed=0, sensors=SENSORS) as env:
        td = env.reset()
        assert all((td[sensor] == 0).all() for sensor in SENSORS)
        for _ in range(30):
            td = env.step(td.set("action", torch.tensor([0.0, 0.0, -1.0])))["next"]
        on_hand = force_on_hand(env, td)
        on_fingers = td["finger_contact"].sum(0)
    # The table pushes both fingers up, and the arm pushes the hand down.
    assert (td["finger_contact"][:, 2] > 50).all()
    assert on_hand[2] < -100
    # The forces of arm, table and gravity balance. The hand still creeps over the
    # table, so its acceleration accounts for up to 1 % of them.
    weight = torch.tensor([0.0, 0.0, -HAND_MASS * G])
    residual = on_hand + on_fingers + weight
    assert residual.norm() < 0.01 * on_fingers.norm()


def test_forces_balance_when_the_hand_holds_a_cube():
    env = torch_panda.make(
        "PandaPickAndPlace-v1", seed=0, sensors=SENSORS, max_episode_steps=200
    )
    td = env.reset()

    def move(target, grip, steps):
        nonlocal td
        for _ in range(steps):
            offset = target(td["observation"]) - td["observation"][:3]
            action = torch.cat(((offset * 8).clamp(-1, 1), torch.tensor([grip])))
            td = env.step(td.set("action", action))["next"]

    move(lambda o: o[7:10] + torch.tensor([0.0, 0.0, 0.1]), 1.0, 12)
    move(lambda o: o[7:10], 1.0, 30)
    free = force_on_hand(env, td)
    move(lambda o: o[7:10], -1.0, 5)
    top = td["observation"][:3] + torch.tensor([0.0, 0.0, 0.15])
    move(lambda o: top, -1.0, 45)
    loaded = force_on_hand(env, td)
    contact, torque = td["finger_contact"], td["joint_torque"]
    simulation = env.episodes.simulation
    arm = simulation.clients[0].state(simulation.scene.robot)
    beside = [arm.link_pose(link)[1] - td["observation"][8] for link in FINGERS]
    assert td["observation"][9] > 0.15, "the cube must hang in the air"
    env.close()
    # The only force of the cube on the fingers is its weight. The cube still
    # accelerates by less than 0.02 m/s^2.
    cube = env.task.object_mass
    weight = torch.tensor([0.0, 0.0, -cube * G])
    torch.testing.assert_close(contact.sum(0), weight, atol=0.02, rtol=0)
    # The cube pushes each finger outwards as hard as its motor pushes inwards.
    assert (contact[:, 1] * torch.tensor(beside) > 0).all()
    torch.testing.assert_close(contact[:, 1].abs(), -torque[ARM:], rtol=0.01, atol=0)
    # The wrist bears the hand, and later the hand and the cube. The arm accelerates by
    # less than 0.1 m/s^2.
    down = torch.tensor([0.0, 0.0, 1.0])
    for measured, mass in ((free, HAND_MASS), (loaded, HAND_MASS + cube)):
        torch.testing.assert_close(measured, mass * G * down, atol=0.1 * mass, rtol=0)


def test_all_contacts_of_a_finger_count():
    """Together they balance the finger's motor."""
    generator = torch.Generator().manual_seed(0)
    with torch_panda.make("PandaPickAndPlace-v1", seed=0, sensors=SENSORS) as env:
        td = env.reset()
        for step in range(35):
            towards = (td["achieved_goal"] - td["observation"][:3]) * 10
            noise = 0.3 * (2 * torch.rand(3, generator=generator) - 1)
            grip = torch.tensor([1.0 if step < 13 else -1.0])
            move = towards + noise if step < 20 else torch.zeros(3)
            td = env.step(td.set("action", torch.cat((move, grip))))["next"]
        simulation = env.episodes.simulation
        contacts = simulation.clients[0].contact_points(simulation.scene.robot)
    links = [contact.link_a for contact in contacts if contact.normal_force > 1]
    assert links.count(FINGERS[0]) > 1
    force, motor = td["finger_contact"][:, 1], td["joint_torque"][ARM:]
    torch.testing.assert_close(force.abs(), -motor, rtol=0.02, atol=0)


def test_the_wrist_bears_the_weight_of_a_tilted_hand():
    with torch_panda.make("PandaReachJoints-v1", seed=0, sensors=SENSORS) as env:
        env.reset()
        state = env.get_state()
        state["joint_position"][5] += 0.9
        td = env.reset(state, set_state=True)
        for _ in range(20):
            td = env.step(td.set("action", torch.zeros(7)))["next"]
        simulation = env.episodes.simulation
        arm = simulation.clients[0].state(simulation.scene.robot)
    rotation = torch.tensor(arm.link_pose(HAND)[3:].tolist())
    force, torque = (
        rotate(rotation, x).double() for x in td["wrist_force_torque"].split(3)
    )
    weight = torch.tensor([0.0, 0.0, -G], dtype=torch.float64)
    torch.testing.assert_close(force, -HAND_MASS * weight, atol=0.01, rtol=0)
    mount = torch.as_tensor(arm.link_pose(MOUNT)[:3])
    expected = torch.zeros(3, dtype=torch.float64)
    for link, mass in PARTS.items():
        lever = torch.as_tensor(arm.link_pose(link)[:3]) - mount
        expected -= torch.linalg.cross(lever, mass * weight)
    assert expected.norm() > 0.3
    torch.testing.assert_close(torque, expected, atol=0.005, rtol=0)


def test_motors_carry_the_arm_at_rest():
    with torch_panda.make("PandaPush-v1", seed=0, sensors=SENSORS) as env:
        td = env.reset()
        for _ in range(20):
            td = env.step(td.set("action", torch.zeros(3)))["next"]
        position = env.get_state()["joint_position"].tolist()
        urdf = find_urdf(env.robot.urdf)
    client = pybullet.connect(pybullet.DIRECT)
    pybullet.setGravity(0, 0, -G)
    arm = pybullet.loadURDF(urdf, useFixedBase=True)
    still = [0.0] * len(position)
    expected = pybullet.calculateInverseDynamics(arm, position, still, still)
    pybullet.disconnect(client)
    torch.testing.assert_close(
        td["joint_torque"][:ARM], torch.tensor(expected[:ARM]), atol=0.02, rtol=0
    )


def test_sensors_do_not_change_the_physics():
    ends = []
    for sensors in ((), SENSORS):
        with torch_panda.make(
            "PandaPickAndPlace-v1", num_envs=3, seed=0, sensors=sensors
        ) as env:
            rollout = env.rollout(50, pusher(env, noise=0.5))
            ends.append((rollout["next", "observation"], env.get_state()))
    assert rollout["next", "finger_contact"].any()
    (ours, our_state), (theirs, their_state) = ends
    assert torch.equal(ours, theirs)
    assert (our_state == their_state).all()


@pytest.mark.parametrize("num_envs", [None, 2])
def test_readings_have_the_shapes_of_their_specs(num_envs):
    batch = () if num_envs is None else (num_envs,)
    with torch_panda.make(
        "PandaStack-v1", num_envs=num_envs, seed=0, sensors=(*SENSORS, "joint_state")
    ) as env:
        check_env_specs(env)
        torch.manual_seed(0)
        td = env.rollout(3)["next"]
        assert td["wrist_force_torque"].shape == (*batch, 3, 6)
        assert td["finger_contact"].shape == (*batch, 3, 2, 3)
        for key in ("joint_torque", "joint_position", "joint_velocity"):
            assert td[key].shape == (*batch, 3, 9)
            assert td[key].dtype == torch.float32
        assert (td["joint_torque"][..., 1].abs() > 1).all()


def test_a_partial_reset_keeps_the_torques_of_other_environments():
    with torch_panda.make("PandaPush-v1", num_envs=2, seed=0, sensors=SENSORS) as env:
        td = env.rollout(3)[:, -1]["next"]
        before = td["joint_torque"].clone()
        mask = torch.tensor([[True], [False]])
        td = env.reset(td.clone().set("_reset", mask))
        assert (td["joint_torque"][0] == 0).all()
        assert (td["joint_torque"][1] == before[1]).all()


class Scalar(JointTorque):
    """Returns one number for all joints."""

    def read(self, client, scene, robot):
        return super().read(client, scene, robot).sum()


def test_a_reading_of_a_wrong_shape_is_refused():
    with torch_panda.make("PandaPush-v1", num_envs=2, sensors=(Scalar(),)) as env:
        message = r"0: ValueError: Scalar.read must return shape \(9,\), got \(\)"
        with pytest.raises(WorkerError, match=message):
            env.rollout(1)


def test_sensors_that_a_robot_cannot_have_are_refused():
    with pytest.raises(ValueError, match=r"'finger_contact', 'joint_torque'.*smell"):
        torch_panda.make("PandaPush-v1", sensors=("smell",))
    with pytest.raises(ValueError, match=r"among \('joint_state', 'joint_torque'\)"):
        RobotTaskEnv(robot=make_kuka(), task=Reach(), sensors=("finger_contact",))
    with RobotTaskEnv(
        robot=make_kuka(), task=Reach(), seed=0, sensors=("joint_torque",)
    ) as env:
        assert env.rollout(2)["next", "joint_torque"].shape == (2, 7)
    # Bullet does not report torques that actions apply.
    robot = make_kuka(control_type="joint_torque", wrist_joint=6)
    with pytest.raises(ValueError, match=r"'wrist_force_torque'\).*got 'joint_torque'"):
        RobotTaskEnv(robot=robot, task=Reach(), sensors=("joint_torque",))
