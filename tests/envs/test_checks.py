"""A mistake in a robot, a task, a scene or a state raises one clear error."""

import pytest
import torch

import torch_panda
from torch_panda import BulletError, Panda, Push, Reach, RobotTaskEnv
from torch_panda.bullet import VectorSimulation
from torch_panda.sensors import CameraSensor
from torch_panda.tasks import Bodies, create_table


def make(task, robot=None, **options):
    return RobotTaskEnv(robot=robot or Panda(block_gripper=True), task=task, **options)


# ---- robot, task, sensors ------------------------------------------------------


def make_kuka(**arguments):
    return torch_panda.Robot(
        **{
            "urdf": "kuka_iiwa/model.urdf",
            "neutral_joint_position": (0.0, 0.5, 0.0, -1.5, 0.0, 1.1, 0.0),
            "effort_limits": (200.0,) * 7,
            "ee_link": 6,
            "ee_orientation": (0.0, 1.0, 0.0, 0.0),
            **arguments,
        }
    )


def make_kuka_env(**arguments):
    return make(Reach(), make_kuka(**arguments))


def too_few_forces():
    robot = make_kuka()
    robot.effort_limits = robot.effort_limits[:-1]
    return make(Reach(), robot)


DEGREES = (0.0, 30.0, 0.0, -90.0, 0.0, 60.0, 0.0)


@pytest.mark.parametrize(
    ("build", "arguments", "error", "message"),
    [
        (make, {"task": Reach}, TypeError, "task must be an .*, got the class Reach"),
        (make, {"task": None}, TypeError, "task must be an instance of Task, got None"),
        (
            make,
            {"task": Reach(), "robot": Panda},
            TypeError,
            "robot must .* class Panda",
        ),
        (make, {"task": Reach(), "robot": Reach()}, TypeError, r"robot .*got Reach\("),
        (
            make,
            {"task": Reach(), "sensors": "joint_state"},
            TypeError,
            "sensors must be a tuple .*got 'joint_state'",
        ),
        (
            make,
            {"task": Reach(), "sensors": (CameraSensor,)},
            TypeError,
            "sensors must .*instance of Sensor, got the class CameraSensor",
        ),
        (make_kuka_env, {"ee_link": 7}, ValueError, "ee_link must be a link .* 0 to 6"),
        (make_kuka_env, {"wrist_joint": 7}, ValueError, "wrist_joint must be a joint"),
        (make_kuka_env, {"wrist_joint": -1}, ValueError, "wrist_joint must be a joint"),
        (make_kuka_env, {"finger_links": (3, 99)}, ValueError, "finger_links .*got 99"),
        (make_kuka, {"num_arm_joints": 0}, ValueError, "num_arm_joints must be"),
        (make_kuka, {"num_arm_joints": 8}, ValueError, "num_arm_joints must be"),
        (
            make_kuka,
            {"neutral_joint_position": (float("nan"),) * 7},
            ValueError,
            "neutral_joint_position must be",
        ),
        (
            make_kuka_env,
            {"neutral_joint_position": DEGREES},
            ValueError,
            "lbr_iiwa_joint_2 .*-2.0944 and 2.0944, got",
        ),
        (
            make_kuka,
            {"effort_limits": (-200.0,) * 7},
            ValueError,
            "effort_limits must be",
        ),
        (too_few_forces, {}, ValueError, "7 movable joints"),
        (
            make_kuka,
            {"ee_orientation": (0,) * 4},
            ValueError,
            "ee_orientation must be a",
        ),
    ],
)
def test_wrong_robots_tasks_and_sensors_are_refused(build, arguments, error, message):
    with pytest.raises(error, match=message):
        build(**arguments)


# ---- scenes ------------------------------------------------------------------


class Forgetful(Reach):
    def build(self, client):
        super().build(client)


class ForgetfulRobot(Panda):
    def build(self, client):
        super().build(client)


def test_builders_that_return_nothing_are_refused():
    with pytest.raises(TypeError, match=r"Forgetful.build must return Bodies, got Non"):
        make(Forgetful())
    with pytest.raises(TypeError, match=r"ForgetfulRobot.build must return the robot"):
        make(Reach(), ForgetfulRobot())
    with pytest.raises(TypeError, match="must return a Scene, got None"):
        VectorSimulation(lambda client: None, 1)


WRIST = """<robot name="arm"><link name="upper"/><link name="lower"/>
<joint name="wrist" type="{}"><axis xyz="0 0 1"/><parent link="upper"/>
<child link="lower"/></joint></robot>"""


class OwnBodies(Reach):
    """Returns the ids that a function of the client returns."""

    def __init__(self, function):
        super().__init__()
        self.function = function

    def build(self, client):
        super().build(client)
        return self.function(client)


@pytest.mark.parametrize(
    ("bodies", "message"),
    [
        (Bodies(objects=1), r"objects of .* tuple of ids from \(0, 1, 2, 3\), got 1"),
        (Bodies(objects=(1, 99)), r"objects of .*got \(1, 99\)"),
        (Bodies(markers=(4,)), r"markers of .*got \(4,\)"),
    ],
)
def test_bodies_that_do_not_exist_are_refused(bodies, message):
    with pytest.raises(ValueError, match=message):
        make(OwnBodies(lambda client: bodies))


@pytest.mark.parametrize(("joint_type", "count"), [("spherical", 3), ("planar", 2)])
def test_objects_with_joints_of_several_degrees_are_refused(
    tmp_path, joint_type, count
):
    path = tmp_path / "wrist.urdf"
    path.write_text(WRIST.format(joint_type))
    task = OwnBodies(lambda client: Bodies(objects=(client.load_urdf(path),)))
    message = f"joint 'wrist' of body 4 must .* one degree of freedom, got {count}"
    with pytest.raises(ValueError, match=message):
        make(task)


class Changing(Push):
    """Builds another cube every time, under the same body ids."""

    def __init__(self, change):
        super().__init__()
        self.change = change
        self.count = 0

    def build(self, client):
        self.count += 1
        create_table(client)
        size = 0.02 + (0.03 * self.count if self.change == "size" else 0.0)
        height = 0.02 + (0.001 * self.count if self.change == "place" else 0.0)
        cube = client.create_box((size,) * 3, mass=1.0, position=(0, 0, height))
        if self.change == "friction":
            client.set_friction(cube, lateral=0.1 * self.count)
        elif self.change == "gravity":
            client.set_gravity(-self.count)
        elif self.change == "sensor":
            robot = client.bodies[0]
            client.enable_wrench_sensor(robot, self.count)
        elif self.change == "number" and self.count > 1:
            client.create_marker((0.0, 0.0, 0.0))
        return Bodies(objects=(cube,))


@pytest.mark.parametrize(
    "change", ["size", "place", "friction", "gravity", "sensor", "number"]
)
def test_scenes_that_differ_between_clients_are_refused(change):
    with pytest.raises(BulletError, match="the same in every client"):
        make(Changing(change), num_envs=2)


def test_pictures_show_the_scene_of_the_simulation():
    """Renderers build from the blueprint, so a later, different build has no effect."""
    task = Changing("size")
    with make(task, seed=0) as env:
        env.reset()
        first = env.render(size=48)
        assert task.count == 1
    with make(task, seed=0) as env:  # a larger cube
        env.reset()
        assert (env.render(size=48) != first).any()
        assert task.count == 2


class Markers(Reach):
    """Two markers by default, but a goal of one position."""

    count = 2

    def build(self, client):
        markers = [client.create_marker((0.0, 0.0, 0.0)) for _ in range(self.count)]
        return Bodies(markers=tuple(markers))


class FlatGoal(Markers):
    goal_dim, count = 2, 1

    def sample_goal(self, rng):
        return (0.0, 0.0)

    def achieved_goal(self, simulation):
        return simulation.ee_position[:, :2]


def test_markers_that_do_not_fit_the_goals_are_refused():
    message = r"Markers.marker_pose must return shape \(3, 2, 7\), got \(3, 1, 7\)"
    with pytest.raises(ValueError, match=message):
        make(Markers(), num_envs=3)
    with pytest.raises(ValueError, match="FlatGoal needs a marker_pose of its own"):
        make(FlatGoal())


# ---- functions ---------------------------------------------------------------


def task_with(name, function):
    return type("Own", (Reach,), {name: function})()


def test_all_wrong_tensors_are_named_at_once():
    task = task_with("observation", lambda s, sim: sim.ee_position)
    type(task).compute_reward = lambda s, a, d: a.sub_(d)[:, :1]
    type(task).failure = lambda s, sim: torch.zeros(1, 1)
    with pytest.raises(ValueError) as caught:
        make(task)
    assert str(caught.value).splitlines() == [
        "Own.observation must return shape (1, 0), got (1, 3)",
        "Own.compute_reward must not change goals or the state of the simulation in "
        "place: change a copy, such as tensor.clone()",
        "Own.failure must return bool, got torch.float32",
    ]


@pytest.mark.parametrize(
    "key",
    ["joint_position", "physics_seed", "actions", "success", "next", "_reset", "_step"],
)
def test_reserved_names_are_refused(key):
    task = task_with("extra_observation", lambda s, sim: {key: sim.joint_position})
    with pytest.raises(ValueError, match=rf"\['{key}'\] are the environment's own"):
        make(task)


def test_observation_keys_that_are_not_strings_are_refused():
    task = task_with("extra_observation", lambda s, sim: {("a", "b"): sim.ee_position})
    with pytest.raises(ValueError, match=r"must be text, got \('a', 'b'\)"):
        make(task)


@pytest.mark.parametrize(
    ("function", "values"),
    [
        ("sample_goal", (0.1,)),
        ("sample_goal", (0.1, 0.1, float("nan"))),
        ("sample_objects", ((0.1, 0.1, 0.02),)),
    ],
)
def test_draws_of_a_wrong_shape_or_not_finite_are_refused(function, values):
    task = Push()
    setattr(task, function, lambda rng: values)
    with (
        make(task) as env,
        pytest.raises(ValueError, match=f"{function} must return finite numbers"),
    ):
        env.reset()


# ---- rotations ---------------------------------------------------------------


def test_quaternions_of_length_zero_are_refused():
    task = Push()
    task.sample_objects = lambda rng: ((0, 0, 0.02, 0, 0, 0, 0),)
    with (
        make(task) as env,
        pytest.raises(ValueError, match=r"sample_objects .*unit q"),
    ):
        env.reset()
    task = torch_panda.Flip()
    task.sample_goal = lambda rng: (0, 0, 0, 0)
    with make(task) as env, pytest.raises(ValueError, match=r"marker pose .*unit qua"):
        env.reset()
    with torch_panda.make("PandaFlip-v1", num_envs=2, seed=0) as env:
        env.reset()
        state = env.get_state()
        bad = state.clone()
        bad["desired_goal"][1] = 0.0
        with pytest.raises(ValueError, match=r"marker pose .*ment 1 .*unit"):
            env.reset(bad, set_state=True)
        assert (env.get_state() == state).all()


# ---- states without set_state ------------------------------------------------


@pytest.fixture
def env():
    with torch_panda.make("PandaPush-v1", num_envs=2, seed=0) as env:
        env.rollout(5)
        yield env


def test_a_reset_starts_from_a_state_without_set_state(env):
    state = env.get_state()
    expected = env.reset(state, set_state=True)
    env.reset()
    assert (env.reset(state) == expected).all()
    env.reset()
    goal = state.select("desired_goal")
    assert torch.equal(env.reset(goal)["desired_goal"], goal["desired_goal"].float())


def test_observations_are_not_taken_for_a_state(env):
    td = env.rollout(3)[:, -1]["next"].exclude("reward")
    td["step_count"] = torch.full((2, 1), 3)  # of torchrl's StepCounter
    goal = td["desired_goal"].clone()
    start = env.reset(td)
    assert not torch.equal(start["desired_goal"], goal)
    assert not env.get_state()["step_count"].any()


def test_a_state_beside_observations_needs_set_state(env):
    td = env.reset(env.get_state(), set_state=True)
    assert "object_pose" in td
    with pytest.raises(ValueError, match="pass set_state=True"):
        env.reset(td)
    env.reset(td, set_state=False)
    # The resets that torchrl does within a rollout start new episodes.
    last = env.get_state()
    last["step_count"][:] = 49
    td = env.reset(last, set_state=True)
    rollout = env.rollout(3, tensordict=td, auto_reset=False, break_when_any_done=False)
    assert rollout["next", "truncated"][:, 0].all()
    goals = rollout["desired_goal"]
    assert not torch.equal(goals[:, 0], goals[:, 1])
