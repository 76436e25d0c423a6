"""`check_task` lists every problem of a task at once."""

import random
import re

import numpy as np
import pytest
import torch

from tests.ids import TASK_IDS
from torch_panda import Kuka, Panda, Push, Reach
from torch_panda.commands import main
from torch_panda.sensors import SENSORS, Entry, Sensor
from torch_panda.tasks import GoalEntries
from torch_panda.testing import check_task


@pytest.mark.parametrize("env_id", TASK_IDS)
def test_a_shipped_task_has_no_problems(env_id):
    check_task(env_id)


def test_the_shipped_sensors_have_no_problems():
    check_task(Reach(), sensors=tuple(SENSORS))


def find_problems(task, **options):
    """The lines of the error."""
    with pytest.raises(ValueError) as caught:
        check_task(task, **options)
    return str(caught.value).splitlines()


def make_task(**functions):
    return type("Own", (Push,), functions)()


def counted(function):
    """A function that also gets the number of its calls so far."""
    count = iter(range(10**6))
    return lambda *args: function(*args, next(count))


def nan_in_row_1(value, count):
    value = value.clone()
    if count > 20:
        value[1] = float("nan")
    return value


def overwrite_the_last_result(self, achieved_goal, desired_goal):
    """A reward that is written into one tensor per shape."""
    reward = -self.distance(achieved_goal, desired_goal)
    buffers = vars(self).setdefault("_buffers", {})
    return buffers.setdefault(reward.shape, reward).copy_(reward)


FAULTS = {
    # shapes and dtypes
    "observation: shape": (
        {"observation": lambda s, sim: sim.ee_position},
        r"Own.observation must return shape \(2, 12\), got \(2, 3\)",
    ),
    "achieved_goal: no tensor": (
        {"achieved_goal": lambda s, sim: (0, 0, 0)},
        "Own.achieved_goal must return a tensor, got a tuple",
    ),
    "marker_pose: shape": (
        {"marker_pose": lambda s, goal: goal},
        r"Own.marker_pose must return shape \(2, 1, 7\), got \(2, 3\)",
    ),
    "is_success: shape": (
        {
            "is_success": lambda s, a, d: (a - d).norm(dim=-1) < 0.05,
            "compute_reward": lambda s, a, d: a[..., :1],
        },
        r"Own.is_success must return shape \(2, 1\), got \(2,\)",
    ),
    "is_success: dtype": (
        {
            "is_success": lambda s, a, d: a[..., :1],
            "compute_reward": lambda s, a, d: a[..., :1],
        },
        "Own.is_success must return bool, got torch.float32",
    ),
    "compute_reward: no tensor": (
        {"compute_reward": lambda s, a, d: 0.0},
        "Own.compute_reward must return a tensor, got a float",
    ),
    "reward: shape": (
        {"reward": lambda s, sim, action, a, d: a[:, 0]},
        r"Own.reward must return shape \(2, 1\), got \(2,\)",
    ),
    "extra_observation: no dict": (
        {"extra_observation": lambda s, sim: sim.ee_position},
        "Own.extra_observation must return a dict of tensors, got a Tensor",
    ),
    "info: rows": (
        {"info": lambda s, sim: {"cost": sim.ee_position[:1]}},
        r"Own.info\['cost'\] must return shape \(2, 3\), got \(1, 3\)",
    ),
    "info: keys that change": (
        {"info": counted(lambda s, sim, n: {f"a{n // 9}": sim.ee_position})},
        "Own.info must always return the entries {'a0': .*, got {'a1'",
    ),
    # numbers
    "observation: NaN": (
        {
            "observation": counted(
                lambda s, sim, n: nan_in_row_1(sim.object_state[:, 0], n)
            )
        },
        r"Own.observation must return finite numbers, .*nan.* for environment 1",
    ),
    "compute_reward: infinity": (
        {"compute_reward": lambda s, a, d: a[..., :1] / 0},
        "Own.compute_reward must return finite numbers",
    ),
    "extra_observation: NaN": (
        {"extra_observation": lambda s, sim: {"a": sim.ee_position * torch.nan}},
        r"Own.extra_observation\['a'\] must return no NaN",
    ),
    "observation without the goal": (
        {
            "observation": lambda s, sim: sim.object_state[:, 0] + 1,
            "goal_entries": GoalEntries("task", (0, 1, 2)),
        },
        r"the columns \[7, 8, 9\] of the observation must be the achieved goal",
    ),
    "goal_entries outside": (
        {"goal_entries": GoalEntries("task", (10, 11, 12))},
        "Own.goal_entries must name 3 numbers of an observation",
    ),
    # changes in place
    "observation: in place": (
        {"observation": lambda s, sim: sim.object_state[:, 0].mul_(1)},
        "Own.observation must not change goals or the state",
    ),
    "compute_reward: in place": (
        {"compute_reward": lambda s, a, d: a.sub_(d)[..., :1]},
        "Own.compute_reward must not change goals or the state",
    ),
    "marker_pose: in place": (
        {"marker_pose": lambda s, goal: Push.marker_pose(s, goal.mul_(1))},
        "Own.marker_pose must not change goals or the state",
    ),
    # purity
    "is_success: random": (
        {
            "is_success": lambda s, a, d: torch.rand_like(a[..., :1]) < 0.5,
            "compute_reward": lambda s, a, d: a[..., :1],
        },
        "Own.is_success must depend on its arguments alone",
    ),
    "compute_reward: mean of the batch": (
        {"compute_reward": lambda s, a, d: (a - d)[..., :1] - (a - d).mean()},
        r"Own.compute_reward must map goals \(..., 3\) to \(..., 1\), each pair",
    ),
    "compute_reward: one leading dimension": (
        {"compute_reward": lambda s, a, d: (a - d).norm(dim=1, keepdim=True)},
        "Own.compute_reward raised IndexError: Dimension out of range",
    ),
    "compute_reward: one tensor for all results": (
        {"compute_reward": overwrite_the_last_result},
        "Own.compute_reward must return new tensors",
    ),
    "compute_reward: NaN for equal goals": (
        {"compute_reward": lambda s, a, d: s.distance(a, d) / s.distance(a, d)},
        "Own.compute_reward must return finite numbers for all goals",
    ),
    # starts and physics
    "sample_goal: shape": (
        {"sample_goal": lambda s, rng: (0.1,)},
        r"an episode raised ValueError: .* numbers of shape \(3,\), got \(0.1,\)",
    ),
    "sample_goal: another generator": (
        {"sample_goal": lambda s, rng: (random.random() / 10, 0.0, 0.02)},
        "two episodes with the same rng start differently: Own.sample_start",
    ),
    "randomize: another generator": (
        {
            "randomize": lambda s, client, bodies, rng: client.set_dynamics(
                bodies.objects[0], mass=1 + random.random()
            ),
            "sample_objects": lambda s, rng: ((0, 0, 0.2, 0.5, 0.5, 0.1, 0.7),),
        },
        "two episodes with the same rng, start and actions differ: Own.randomize",
    ),
    # errors
    "info: error": (
        {"info": lambda s, sim: {"a": sim.no_such_tensor}},
        "Own.info raised AttributeError: .*no_such_tensor",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_reported_together_with_another_one(fault):
    functions, message = FAULTS[fault]
    task = make_task(failure=lambda s, sim: torch.zeros(2, 1), **functions)
    lines = find_problems(task)
    assert "Own.failure must return bool, got torch.float32" in lines
    (line,) = [line for line in lines if not line.startswith("Own.failure")]
    assert re.match(message, line)


def test_faults_of_all_functions_are_reported_at_once():
    functions = {
        name: FAULTS[fault][0][name]
        for name, fault in (
            ("observation", "observation: in place"),
            ("achieved_goal", "achieved_goal: no tensor"),
            ("is_success", "is_success: shape"),
            ("compute_reward", "compute_reward: one leading dimension"),
            ("marker_pose", "marker_pose: shape"),
            ("reward", "reward: shape"),
            ("extra_observation", "extra_observation: NaN"),
            ("info", "info: error"),
        )
    }
    lines = find_problems(make_task(**functions))
    assert [re.match(r"Own\.(\w+)", line)[1] for line in lines] == [
        *("observation", "achieved_goal", "is_success", "marker_pose", "reward"),
        *("info", "extra_observation", "compute_reward"),
    ]


class Blind(Panda):
    observation_dim = 9


def test_a_robot_is_checked_with_its_task():
    task = make_task(failure=lambda s, sim: torch.zeros(2, 1))
    assert find_problems(task, robot=Blind()) == [
        "Blind.observation must return shape (2, 9), got (2, 7)",
        "Own.failure must return bool, got torch.float32",
    ]


class Height(Sensor):
    """Observes what a function of the height of the hand returns."""

    def __init__(self, function):
        self.function = function

    def attach(self, simulation, renderer, robot):
        return HeightReading(self.function, simulation)


class HeightReading:
    def __init__(self, function, simulation):
        self.function, self.simulation = function, simulation
        self.entries = {"height": Entry((1,), torch.float64)}
        self.buffer = torch.zeros(2, 1, dtype=torch.float64)

    def after_reset(self, envs): ...

    def after_step(self, envs): ...

    def observe(self):
        return self.function(self, self.simulation.ee_position[:, 2:])


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda s, z: {"z": z.clone()}, "'height' must return a tensor, got None"),
        (lambda s, z: {"height": z[:, 0].clone()}, r"shape \(2, 1\), got \(2,\)"),
        (lambda s, z: {"height": z.float()}, "float64, got torch.float32"),
        (lambda s, z: {"height": z}, "must return new tensors"),
        (lambda s, z: {"height": s.buffer.copy_(z)}, "must return new tensors"),
    ],
)
def test_faults_of_a_sensor_are_reported(function, message):
    (line,) = find_problems(Reach(), sensors=(Height(function),))
    assert re.search(message, line)


@pytest.mark.parametrize(
    ("task", "robot", "message"),
    [
        (Reach, None, "task must be an instance of Task, got the class Reach"),
        (Reach(), Panda, "robot must be an instance of Robot, got the class Panda"),
    ],
)
def test_classes_are_refused(task, robot, message):
    with pytest.raises(TypeError, match=message):
        check_task(task, robot=robot)


def test_a_reserved_key_is_reported():
    task = make_task(info=lambda s, sim: {"episode": sim.ee_position})
    (line,) = find_problems(task)
    assert "must not return ['episode']" in line


def test_infinite_entries_of_hooks_are_no_problem():
    check_task(make_task(extra_observation=lambda s, sim: {"a": sim.ee_position / 0}))


def test_the_check_changes_neither_its_arguments_nor_global_random_numbers():
    task, robot = Push(), Kuka()
    torch.manual_seed(0)
    np.random.seed(0)
    before = torch.get_rng_state(), np.random.get_state()[1].copy()
    check_task(task, robot=robot)
    task.object_mass, robot.block_gripper = 3.0, True  # not frozen
    assert torch.equal(torch.get_rng_state(), before[0])
    assert (np.random.get_state()[1] == before[1]).all()


def test_the_first_error_of_a_function_is_the_cause():
    task = make_task(info=lambda s, sim: {"a": sim.no_such_tensor})
    with pytest.raises(ValueError) as caught:
        check_task(task, robot=Panda(block_gripper=True))
    assert isinstance(caught.value.__cause__, AttributeError)


MODULE = """
import torch_panda
from torch_panda import Panda, Reach

class Wrong(Reach):
    def info(self, simulation):
        return {"cost": simulation.ee_velocity / 0}

    def compute_reward(self, achieved_goal, desired_goal):
        return (achieved_goal - desired_goal).sum()

torch_panda.register("Wrong-v0", robot=Panda, task=Wrong)
"""


def test_train_checks_the_task_before_it_begins(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "wrong_task.py").write_text(MODULE)
    train = ["train", "--env-id", "Wrong-v0", "--import", "wrong_task.py"]
    with pytest.raises(SystemExit) as caught:
        main([*train, "--out", "run"])
    lines = str(caught.value).splitlines()
    assert any("Wrong.compute_reward must return shape (2, 1)" in x for x in lines)
    assert any("Wrong.info['cost'] must return no NaN" in x for x in lines)
    assert not (tmp_path / "run").exists()
