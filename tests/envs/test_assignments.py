"""Assignments to a task, a robot or an environment have an effect or are refused."""

import copy
import pickle
from dataclasses import dataclass

import pytest
import torch

import torch_panda
from torch_panda import Drawer, Panda, PegInsertion, Push, Reach, RobotTaskEnv, Task
from torch_panda.tasks import create_table


def make(task, robot=None, **options):
    robot = robot or Panda(block_gripper=True)
    return RobotTaskEnv(robot=robot, task=task, seed=0, **options)


@pytest.fixture(scope="module")
def env():
    with make(Push(), num_envs=8) as env:
        yield env


# ---- what may change -----------------------------------------------------------


def test_changes_of_a_task_take_effect(env):
    env.task.goal_xy_range = env.task.obj_xy_range = 0.01
    start = env.reset()
    assert start["desired_goal"][:, :2].abs().max() <= 0.005
    assert start["achieved_goal"][:, :2].abs().max() <= 0.005
    assert start["success"].all()
    env.task.distance_threshold = 0.0
    assert not env.reset()["success"].any()
    env.task.reward_type = "dense"
    reward = env.step(env.rand_action(env.reset()))["next", "reward"]
    assert ((reward < 0) & (reward > -1)).all()


def test_a_changed_action_scale_takes_effect(env):
    def moved():
        td = env.reset()
        action = torch.ones(env.action_spec.shape)
        after = env.step(td.set("action", action))["next", "observation"]
        return (after - td["observation"])[:, 2].mean()

    env.robot.action_scale = 0.05
    whole = moved()
    env.robot.action_scale = 0.001
    assert moved() < whole / 2
    env.robot.action_scale = 0.05


@pytest.mark.parametrize(
    ("task", "name", "value"),
    [
        (Push, "reward_type", "nonsense"),
        (PegInsertion, "distance_threshold", 0.04),  # above the depth
        (Drawer, "min_change", 0.2),
    ],
)
def test_a_change_is_checked_as_by_the_constructor(task, name, value):
    with make(task()) as env:
        before = getattr(env.task, name)
        with pytest.raises(ValueError, match=f"{name}"):
            setattr(env.task, name, value)
        assert getattr(env.task, name) == before


def test_a_value_changed_before_the_environment_is_checked_when_it_is_made():
    task = Reach()
    task.goal_range = -0.1
    with pytest.raises(ValueError, match="goal_range must be finite and at least 0"):
        make(task)


# ---- refused assignments ---------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("goal", r"no option 'goal'; to start episodes with a goal, call env\.reset\("),
        ("goal_range", "no option 'goal_range'; did you mean 'goal_xy_range'.* option"),
        ("max_episode_steps", "max_episode_steps cannot be changed in the Push"),
        ("object_mass", "arguments that can change are reward_type, distance_thr"),
        ("sample_goal", "it is a method: override it in a subclass of Push"),
        ("marker_pose", "it is a method"),
    ],
)
def test_an_assignment_to_a_task_without_effect_is_refused(env, name, message):
    before = repr(env.task)
    with pytest.raises(AttributeError, match=message):
        setattr(env.task, name, 0.1)
    assert repr(env.task) == before


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("fingers_width", "fingers_width cannot be replaced .* method"),
        ("effort_limits", "arguments that can change are action_scale"),
    ],
)
def test_an_assignment_to_a_robot_without_effect_is_refused(env, name, message):
    with pytest.raises(AttributeError, match=message):
        setattr(env.robot, name, 0.1)


def test_every_argument_is_frozen_unless_it_is_changeable():
    # The shipped tasks read these arguments anew in every episode or step.
    changeable = {"reward_type", "distance_threshold", "min_change", "goal_x_offset"}
    for task_class in (torch_panda.Slide, torch_panda.Stack, Drawer, PegInsertion):
        with make(task_class()) as env:
            for name in [name for name in vars(env.task) if name[0] != "_"]:
                value = getattr(env.task, name)
                if name in changeable or name.endswith("_range"):
                    setattr(env.task, name, value)
                    continue
                with pytest.raises(AttributeError, match=f"{name} cannot be changed"):
                    setattr(env.task, name, value)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("task", Push()),
        ("on_divergence", "reset"),
        ("episodes", None),
    ],
)
def test_an_argument_of_a_live_environment_is_refused(env, name, value):
    with pytest.raises(AttributeError, match=f"{name} of a live environment cannot"):
        setattr(env, name, value)
    env.rollout(2)


def test_an_option_of_a_task_or_robot_is_refused_on_the_environment(env):
    with pytest.raises(AttributeError, match=r"see env\.task\.goal_xy_range"):
        env.goal_xy_range = 0.1
    with pytest.raises(AttributeError, match=r"see env\.robot\.action_scale"):
        env.action_scale = 0.1
    env.note = "my own attribute"


@pytest.mark.parametrize("name", ["build", "compute_reward", "marker_pose"])
def test_methods_that_are_looked_up_in_the_class_cannot_be_replaced(name):
    with pytest.raises(AttributeError, match="override it in a subclass of Push"):
        setattr(Push(), name, torch.zeros_like)
    with pytest.raises(AttributeError, match="override it in a subclass of Panda"):
        Panda().setpoint = torch.zeros_like


# ---- users' tasks ------------------------------------------------------------------


class Curriculum(Reach):
    """A task without a decorator that keeps state of its own."""

    changeable = ("level",)
    episodes = 0
    last_goal = None

    def __init__(self, *, level=1, note="", **options):
        self.level, self.note = level, note
        super().__init__(**options)
        self.buffer = torch.zeros(3)
        self.options = options  # not the name of an argument, but of all others

    def build(self, client):
        self.table = create_table(client)
        return super().build(client)

    def check_arguments(self):
        super().check_arguments()
        if self.level < 0:
            raise ValueError(f"level must be at least 0, got {self.level}")

    def sample_goal(self, rng):
        self.episodes += 1
        self._private = self.options = None
        self.last_goal = tuple(x * self.level for x in super().sample_goal(rng))
        self.buffer = torch.tensor(self.last_goal)
        return self.last_goal


def test_a_users_task_keeps_its_own_state():
    with make(Curriculum(level=0)) as env:
        assert not env.reset()["desired_goal"].any()
        env.task.level = 1
        goal = env.reset()["desired_goal"]
        assert torch.equal(goal, env.task.buffer.float())
        assert env.task.episodes == 2
        with pytest.raises(AttributeError, match=r"note cannot .* names to its attr"):
            env.task.note = "changed"
        with pytest.raises(ValueError, match="level must be at least 0"):
            env.task.level = -1
        assert env.task.level == 1
        with pytest.raises(AttributeError, match=r"state of your own needs"):
            env.task.levels = 3


def test_two_environments_share_a_users_task():
    task = Curriculum()
    with make(task) as env, make(task) as other:
        assert torch.equal(env.reset()["desired_goal"], other.reset()["desired_goal"])
        assert task.episodes == 2


@dataclass(kw_only=True)
class Counting(Push):
    """A user's dataclass, which is compared by its fields and has no hash."""

    changeable = ("bonus",)

    bonus: float = 1.0
    penalty: float = 0.0
    count = 0

    def reward(self, simulation, action, achieved_goal, desired_goal):
        self.count += 1
        reward = self.compute_reward(achieved_goal, desired_goal)
        return reward.clone().fill_(self.bonus)


def test_a_users_dataclass_keeps_its_own_state():
    with make(Counting()) as env:
        env.task.bonus = 3.0
        assert (env.rollout(3)["next", "reward"] == 3).all()
        assert env.task.count == 4  # also when the environment was made
        with pytest.raises(AttributeError, match="penalty cannot be changed"):
            env.task.penalty = 1.0


class Property(Push):
    """A task with a property that sets an argument."""

    @property
    def difficulty(self):
        return self.goal_xy_range / 0.3

    @difficulty.setter
    def difficulty(self, value):
        self.goal_xy_range = 0.3 * value


def test_a_users_property_stays_assignable():
    with make(Property()) as env:
        env.task.difficulty = 0.5
        assert env.task.goal_xy_range == 0.15


@pytest.mark.parametrize(
    "duplicate", [copy.copy, copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))]
)
@pytest.mark.parametrize("task", [Push(), Curriculum(), Counting()])
def test_a_copy_of_a_frozen_task_can_be_configured_anew(duplicate, task):
    with make(task):
        twin = duplicate(task)
        twin.table_friction = 0.3
        with make(twin) as env:
            assert env.task.table_friction == 0.3 != task.table_friction
        with pytest.raises(AttributeError, match="table_friction cannot be changed"):
            task.table_friction = 0.3


def test_a_pickled_environment_has_a_frozen_task():
    with make(Counting(penalty=2.0)) as env, pickle.loads(pickle.dumps(env)) as twin:
        assert twin.task.penalty == 2.0
        with pytest.raises(AttributeError, match="penalty cannot be changed"):
            twin.task.penalty = 1.0


def test_an_environment_that_cannot_be_built_freezes_nothing():
    task = Push()
    with pytest.raises(ValueError, match="num_envs"):
        make(task, num_envs=0)
    task.object_mass = 3.0


class Undecorated(Push):
    goal_xy_range = 0.1


class Unparameterised(Task):
    distance_threshold: float = 0.02


@pytest.mark.parametrize("task", [Undecorated, Unparameterised])
def test_a_default_that_the_constructor_would_replace_is_refused(task):
    message = r"no effect, .* write @dataclass\(kw_only=True\) .*: float = 0.\d+$"
    with pytest.raises(TypeError, match=message):
        task()
