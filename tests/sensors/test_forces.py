"""Force sensors against Newton's laws: press the table, lift a cube."""

import pytest
import torch
from torchrl.envs.utils import check_env_specs

import torch_panda
from tests.envs.test_checks import make_kuka
from torch_panda import Reach, RobotTaskEnv
from torch_panda.rotations import rotate

SENSORS = ("wrist_force_torque", "finger_contact", "joint_torque")
G = 9.81  # [m/s^2]
HAND_MASS = 0.81 + 2 * 0.1  # [kg], of hand and fingers in the URDF
HAND = 8
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
    assert td["observation"][9] > 0.15, "the cube must hang in the air"
    env.close()
    # The only force of the cube on the fingers is its weight. The cube still
    # accelerates by less than 0.02 m/s^2.
    cube = env.task.object_mass
    weight = torch.tensor([0.0, 0.0, -cube * G])
    torch.testing.assert_close(contact.sum(0), weight, atol=0.02, rtol=0)
    # The cube pushes each finger outwards as hard as its motor pushes inwards.
    assert contact[0, 1] * contact[1, 1] < 0
    torch.testing.assert_close(contact[:, 1].abs(), -torque[ARM:], rtol=0.01, atol=0)
    # The wrist bears the hand, and later the hand and the cube. The arm accelerates by
    # less than 0.1 m/s^2.
    down = torch.tensor([0.0, 0.0, 1.0])
    for measured, mass in ((free, HAND_MASS), (loaded, HAND_MASS + cube)):
        torch.testing.assert_close(measured, mass * G * down, atol=0.1 * mass, rtol=0)


def test_sensors_do_not_change_the_physics():
    def pull(td):
        """Fingers, cube and table touch."""
        noise = torch.rand(3, 4, generator=generator) * 2 - 1
        towards = (td["achieved_goal"] - td["observation"][:, :3]) * 10
        noise[:, :3] = noise[:, :3] * 0.5 + towards
        return td.set("action", noise)

    ends = []
    for sensors in ((), SENSORS):
        generator = torch.Generator().manual_seed(0)
        with torch_panda.make(
            "PandaPickAndPlace-v1", num_envs=3, seed=0, sensors=sensors
        ) as env:
            rollout = env.rollout(50, pull)
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
