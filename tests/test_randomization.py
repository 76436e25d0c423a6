"""Physics that are drawn for every episode."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

import torch_panda
from tests.pushing import pusher
from torch_panda import Randomization, RobotTaskEnv
from torch_panda.envs.randomization import PARAMETERS

ALL = Randomization(
    object_mass=(0.5, 2.0),
    object_friction=(0.5, 1.5),
    table_friction=(0.5, 1.5),
    finger_friction=(0.5, 1.5),
    object_restitution=(0.0, 0.5),
    joint_damping=(0.5, 2.0),
    gravity=(0.9, 1.1),
    joint_position=0.05,
    observe=True,
)
ID = "PandaPickAndPlace-v1"


def push(env):
    """Move the hand to the cube and push it."""
    policy, td, seen = pusher(env), env.reset(), []
    for _ in range(25):
        td = env.step(policy(td.clone()))["next"]
        seen.append(td)
    return torch.stack(seen)


def make(randomize=ALL, **options):
    return torch_panda.make(
        ID, **({"num_envs": 3, "seed": 0} | options), randomize=randomize
    )


def test_parameters_are_drawn_per_environment_and_episode():
    with make() as env:
        check_env_specs(env)
        env.set_seed(0)
        drawn = torch.stack([env.reset()["physics_parameters"] for _ in range(4)])
    assert drawn.shape == (4, 3, len(PARAMETERS))
    assert len(drawn.flatten().unique()) == drawn.numel()
    low, high = torch.tensor([getattr(ALL, name) for name in PARAMETERS]).T
    assert ((low <= drawn) & (drawn <= high)).all()
    with make(num_envs=1) as other:  # whatever the number of environments
        for expected in drawn:
            assert torch.equal(other.reset()["physics_parameters"], expected[:1])


def test_episodes_are_reproducible_and_states_exact():
    with make() as env, make(num_threads=1) as other:
        push(env)
        env.set_seed(0)
        first = push(env)
        assert (push(other) == first).all()
        state = env.get_state(exact=True)
        after = env.rand_step(first[-1].exclude("reward", "action"))
        again = env.reset(state[[2, 2, 2]], set_state=True)
        again["action"] = after["action"][[2, 2, 2]]
        assert (env.step(again)["next"] == after["next"][[2, 2, 2]]).all()


def test_without_randomization_nothing_changes():
    """Goals and objects are drawn as without randomization."""
    with make(None) as plain, make() as varied, make(Randomization()) as empty:
        start, other = plain.reset(), varied.reset()
        for key in ("desired_goal", "achieved_goal"):
            assert torch.equal(start[key], other[key])
        assert not torch.equal(start["observation"], other["observation"])
        plain.set_seed(0)
        assert (push(plain) == push(empty)).all()
        assert set(plain.get_state().keys()) == set(empty.get_state().keys())


def test_factors_of_one_change_nothing():
    ones = Randomization(
        **{name: (1.0, 1.0) for name in PARAMETERS[:4]}, gravity=(1, 1)
    )
    with make(None) as plain, make(ones) as same:
        assert (push(plain) == push(same)).all()


class Measured(torch_panda.Stack):
    """Reads the physics of its environment after the randomization changed them."""

    def __init__(self):
        super().__init__(object_mass=(2.0, 1.0))
        self.physics = {}

    def randomize(self, client, bodies, rng):
        robot = client.bodies[0]
        others = {*client.bodies} - {robot, *bodies.objects, *bodies.markers}
        self.physics = {
            "object_mass": [client.mass(body) for body in bodies.objects],
            "object_friction": [client.friction(body) for body in bodies.objects],
            "table_friction": [client.friction(body) for body in sorted(others)],
            "finger_friction": [client.friction(robot, link) for link in (9, 10)],
            "object_restitution": [client.restitution(body) for body in bodies.objects],
            "table_restitution": [client.restitution(body) for body in sorted(others)],
        }


NOMINAL = {
    "object_mass": [2.0, 1.0],
    "object_friction": [5.0, 5.0],
    "table_friction": [0.5, 0.1],  # of the ground and of the table
    "finger_friction": [1.0, 1.0],
    "object_restitution": [0.0, 0.0],
    "table_restitution": [0.0, 0.0],
}


@pytest.mark.parametrize("name", [*PARAMETERS[:5], None])
def test_a_factor_multiplies_the_property_of_its_bodies_alone(name):
    expected = dict(NOMINAL)
    if name == "object_restitution":  # 0 times the factor would be 0
        expected |= {name: [0.6, 0.6], "table_restitution": [1.0, 1.0]}
    elif name is not None:
        expected[name] = [0.6 * value for value in NOMINAL[name]]
    ranges = {} if name is None else {name: (0.6, 0.6)}
    robot, task = torch_panda.Panda(), Measured()
    randomize = Randomization(**ranges)
    with RobotTaskEnv(robot=robot, task=task, randomize=randomize) as env:
        for _ in range(2):  # factors do not accumulate
            env.reset()
            for key, values in expected.items():
                assert task.physics[key] == pytest.approx(values), key


def test_a_factor_of_gravity_changes_how_objects_fall():
    speeds = []
    for factor in (1.0, 0.5):
        with make(Randomization(gravity=(factor, factor))) as env:
            env.reset()
            state = env.get_state()
            state["object_pose"][..., 2] = 1.0
            td = env.reset(state, set_state=True)
            env.step(td.set("action", torch.zeros(env.action_spec.shape)))
            speeds.append(env.get_state()["object_velocity"][:, 0, 2])
    torch.testing.assert_close(speeds[1], 0.5 * speeds[0], rtol=0.01, atol=0)
    assert speeds[0] == pytest.approx([-9.81 * 0.04] * 3, rel=0.01)


def test_damping_slows_a_falling_arm_down():
    randomize = Randomization(joint_damping=(5.0, 5.0))
    options = {"robot_options": {"control_type": "joint_torque"}, "num_envs": 1}
    speeds = []
    for physics in (None, randomize):
        with make(physics, **options) as env:
            td = env.reset()
            for _ in range(4):
                td["action"] = torch.zeros(env.action_spec.shape)
                td = env.step(td)["next"]
            speeds.append(env.get_state()["joint_velocity"][0, 1].item())
    assert 0 < speeds[1] < 0.9 * speeds[0]


class DampedPanda(torch_panda.Panda):
    """A Panda whose `build` sets the damping of its joints."""

    def build(self, client):
        body = super().build(client)
        for joint in client.joints(body):
            client.set_dynamics(body, joint.number, joint_damping=0.5)
        return body


class MoonReach(torch_panda.Reach):
    """`build` sets gravity, and adds a box that moves and is not among the objects."""

    def build(self, client):
        self.box = client.create_box((0.1,) * 3, mass=1.0, position=(0.5, 0, 1))
        client.set_gravity(-1.62)
        return super().build(client)


def test_physics_that_build_sets_are_the_nominal_ones():
    """Factors of 1 keep them."""
    ends = []
    for ranges in ((), ("gravity", "joint_damping")):
        randomize = Randomization(**dict.fromkeys(ranges, (1.0, 1.0)))
        robot, task = DampedPanda(control_type="joint_torque"), MoonReach()
        with RobotTaskEnv(robot=robot, task=task, randomize=randomize, seed=0) as env:
            td = env.reset()
            for _ in range(4):
                td = env.step(td.set("action", torch.zeros(8)))["next"]
            ends.append(td["observation"])
            (client,) = env.episodes.simulation.clients
            speed = client.state(task.box).base_velocity[2]
    assert torch.equal(*ends)
    assert speed == pytest.approx(-1.62 * 0.16, rel=0.01)


def test_only_fixed_bodies_count_as_tables():
    task = MoonReach()
    randomize = Randomization(table_friction=(0.1, 0.1), object_restitution=(0.5, 0.5))
    with RobotTaskEnv(robot=torch_panda.Panda(), task=task, randomize=randomize) as env:
        env.reset()
        (client,) = env.episodes.simulation.clients
        assert client.friction(task.box) == 0.5
        assert client.restitution(task.box) == 0.0


def test_masses_change_and_a_state_can_set_them():
    with make(Randomization(object_mass=(0.5, 2.0))) as env:
        env.reset()
        client = env.episodes.simulation.clients[1]
        (cube,) = env.episodes.simulation.scene.objects
        factor = env.get_state()["physics_parameters"][1].item()
        assert client.mass(cube) == pytest.approx(2.0 * factor)
        state = env.get_state()
        state["physics_parameters"][:] = torch.tensor([[0.5], [0.25], [3.0]])
        env.reset(state, set_state=True)
        assert client.mass(cube) == 0.5
        env.reset()
        assert client.mass(cube) != 0.5
        factors = torch.full((3, 1), 1.5)
        for set_state in (True, None):
            state = TensorDict({"physics_parameters": factors}, [3])
            env.reset(state, set_state=set_state)
            assert (env.get_state()["physics_parameters"] == 1.5).all()
        assert client.mass(cube) == 3.0


@pytest.mark.parametrize(
    ("key", "name", "factor"),
    [
        ("physics_parameters", "object_mass", -1.0),
        ("physics_parameters", "object_mass", 0.0),
        ("physics_parameters", "gravity", -0.5),
        ("start_physics_parameters", "object_friction", -1.0),
    ],
)
def test_impossible_physics_are_refused_and_change_nothing(key, name, factor):
    with make() as env:
        env.reset()
        before = env.get_state(exact=True)
        state = before.clone()
        state[key][1, PARAMETERS.index(name)] = factor
        with pytest.raises(ValueError, match="physics_parameters of environment 1 mus"):
            env.reset(state, set_state=True)
        assert (env.get_state(exact=True) == before).all()
        state = env.get_state()
        state["physics_parameters"][:, PARAMETERS.index("gravity")] = 0.0
        env.reset(state, set_state=True)


def test_joint_positions_start_around_neutral():
    with make(Randomization(joint_position=0.1)) as env:
        env.reset()
        state = env.get_state()
        offset = state["joint_position"] - torch.tensor(
            env.robot.neutral_joint_position, dtype=torch.float64
        )
        assert "physics_parameters" not in state
    arm = offset[:, :7]
    assert (arm.abs() <= 0.1).all() and (arm > 0).any() and (arm < 0).any()
    assert len(arm.unique()) == arm.numel()
    assert not offset[:, 7:].any()


@pytest.mark.parametrize("env_id", ["PandaReach-v1", "PandaStack-v3"])
def test_every_task_can_be_randomized(env_id):
    with torch_panda.make(env_id, randomize=ALL) as env:
        assert env.reset()["physics_parameters"].shape == (len(PARAMETERS),)


@pytest.mark.parametrize(
    "options",
    [
        {"object_mass": (2.0, 1.0)},
        {"object_mass": (0.0, 1.0)},
        {"gravity": 1.0},
        {"table_friction": (-1.0, 1.0)},
        {"joint_position": float("nan")},
        {"joint_position": None},
        {"joint_position": "0.1"},
        {"observe": True},
    ],
)
def test_bad_ranges_are_refused(options):
    with pytest.raises((ValueError, TypeError), match=r"must be|needs a range"):
        Randomization(**options)
