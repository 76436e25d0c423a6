"""A task and a robot that a user defines."""

import pytest
from torchrl.envs.utils import check_env_specs

from torch_panda import Panda, Reach, Robot, RobotTaskEnv, Task
from torch_panda.rotations import NO_ROTATION
from torch_panda.tasks import Bodies, create_table, object_observation

RADIUS = 0.03  # [m]


class PushBall(Task):
    """Push a ball of 0.5 kg to a point on the table."""

    goal_dim = 3
    observation_dim = 12
    max_episode_steps = 30

    def build(self, client):
        create_table(client)
        ball = client.create_sphere(RADIUS, mass=0.5, position=(0.0, 0.0, RADIUS))
        client.set_friction(ball, lateral=0.5)
        return Bodies(objects=(ball,))

    def sample_goal(self, rng):
        return (*rng.uniform(-0.15, 0.15, size=2), RADIUS)

    def sample_objects(self, rng):
        return ((*rng.uniform(-0.1, 0.1, size=2), RADIUS, *NO_ROTATION),)

    def observation(self, simulation):
        return object_observation(simulation, 0)

    def achieved_goal(self, simulation):
        return simulation.object_pose[:, 0, :3]


def make_kuka(**arguments):
    return Robot(
        **{
            "urdf": "kuka_iiwa/model.urdf",
            "neutral_joint_position": (0.0, 0.5, 0.0, -1.5, 0.0, 1.1, 0.0),
            "joint_forces": (200.0,) * 7,
            "ee_link": 6,
            "ee_orientation": (0.0, 1.0, 0.0, 0.0),
            **arguments,
        }
    )


def test_a_task_of_a_user_runs():
    task = PushBall(distance_threshold=0.03)
    with RobotTaskEnv(
        robot=Panda(block_gripper=True), task=task, num_envs=2, seed=0
    ) as env:
        check_env_specs(env)
        td = env.reset()
        start = td["achieved_goal"].clone()
        for _ in range(29):
            action = (td["achieved_goal"] - td["observation"][:, :3]) * 20
            td = env.step(td.set("action", action))["next"]
        assert not td["done"].any()
        td = env.step(td.set("action", action))["next"]
        assert td["truncated"].all()
        # The arm has pushed the balls.
        assert ((td["achieved_goal"] - start).norm(dim=1) > 0.005).all()


@pytest.mark.parametrize(
    ("function", "values"),
    [
        ("sample_goal", (0.1,)),
        ("sample_goal", (0.1, 0.1, float("nan"))),
        ("sample_objects", ((0.1, 0.1, RADIUS),)),
    ],
)
def test_draws_of_a_wrong_shape_or_not_finite_are_refused(
    monkeypatch, function, values
):
    monkeypatch.setattr(PushBall, function, lambda self, rng: values)
    with (
        RobotTaskEnv(robot=Panda(block_gripper=True), task=PushBall()) as env,
        pytest.raises(ValueError, match=f"{function} must return finite numbers"),
    ):
        env.reset()


@pytest.mark.parametrize(
    "options",
    [
        {"ee_link": 7},
        {"wrist_joint": 7},
        {"wrist_joint": -1},
        {"finger_links": (3, 99)},
    ],
)
def test_links_and_joints_that_the_urdf_lacks_are_refused(options):
    (name,) = options
    with pytest.raises(ValueError, match=f"{name} must be a .* 0 to 6, got"):
        RobotTaskEnv(robot=make_kuka(**options), task=Reach())


@pytest.mark.parametrize(
    "options",
    [
        {"num_arm_joints": 0},
        {"num_arm_joints": -1},
        {"num_arm_joints": 8},
        {"base_position": (0.0, 0.0)},
        {"base_position": (0.0, 0.0, float("nan"))},
        {"neutral_joint_position": (float("nan"),) * 7},
    ],
)
def test_numbers_out_of_range_are_refused(options):
    (name,) = options
    with pytest.raises(ValueError, match=f"{name} must be"):
        make_kuka(**options)


def test_a_wrong_number_of_joint_forces_is_refused():
    robot = make_kuka()
    robot.joint_forces = robot.joint_forces[:-1]
    with pytest.raises(ValueError, match="7 movable joints"):
        RobotTaskEnv(robot=robot, task=Reach())
