"""An overridden method of a task is called, or an error says what to override."""

import pytest

from torch_panda import Drawer, Panda, PegInsertion, Push, RobotTaskEnv
from torch_panda.tasks import Start


def make(task):
    return RobotTaskEnv(robot=Panda(block_gripper=True), task=task, seed=0)


class GoalOfADrawer(Drawer):
    def sample_goal(self, rng):
        return (0.0, 0.0, 0.06)


class HoleInTheMiddle(PegInsertion):
    def sample_objects(self, rng):
        return ((0, 0, 0.2, 0, 0, 0, 1), (0, 0, 0, 0, 0, 0, 1))


class StartInTheMiddle(Push):
    """A user's base class that draws the goal and the objects together."""

    def sample_start(self, rng):
        return Start((0.1, 0.0, 0.02), ((0.0, 0.0, 0.02, 0.0, 0.0, 0.0, 1.0),))


class GoalOfAUsersBase(StartInTheMiddle):
    def sample_goal(self, rng):
        return (0.1, 0.1, 0.02)


@pytest.mark.parametrize(
    ("task", "message"),
    [
        (GoalOfADrawer, r"sample_goal of GoalOfADrawer .* Drawer\.sample_start draws"),
        (HoleInTheMiddle, r"sample_objects of Hole.* PegInsertion\.sample_start draws"),
        (GoalOfAUsersBase, r"sample_goal of .* StartInTheMiddle\.sample_start draws"),
    ],
)
def test_an_override_that_is_never_called_is_refused(task, message):
    with pytest.raises(ValueError, match=message + r".*: override sample_start"):
        make(task())


@pytest.mark.parametrize("name", ["sample_goal", "sample_object_joints"])
def test_a_function_of_an_object_that_is_never_called_is_refused(name):
    task = Drawer()
    setattr(task, name, lambda rng: (0.1,))
    with pytest.raises(ValueError, match=f"{name} of Drawer would never be called"):
        make(task)


class Counting(StartInTheMiddle):
    def sample_start(self, rng):
        self.sample_goal(rng)
        return super().sample_start(rng)


class CountsItsGoals(Counting):
    level = 0

    def sample_goal(self, rng):
        self.level += 1
        return super().sample_goal(rng)


def test_looking_for_overrides_does_not_change_the_task():
    with make(CountsItsGoals()) as env:
        assert env.task.level == 0


class Composed(Push):
    """A user's base class whose `sample_start` calls the goal in some episodes."""

    draws = 0

    def sample_start(self, rng):
        self.draws += 1
        objects = self.sample_objects(rng)
        goal = self.sample_goal(rng) if rng.random() < 0.5 else objects[0][:3]
        return Start(goal, objects)


class GoalOfComposed(Composed):
    def sample_goal(self, rng):
        return (0.1, 0.1, 0.02)


class Failing(Composed):
    """Its draws fail until the environment calls `randomize`."""

    ready = False

    def sample_objects(self, rng):
        if not self.ready:
            raise RuntimeError("not ready")
        return super().sample_objects(rng)


def test_an_override_that_is_called_is_accepted():
    with make(GoalOfComposed()) as env:
        assert env.task.draws == 0  # the check draws on a copy
        goals = {tuple(env.reset()["desired_goal"].tolist()) for _ in range(20)}
        assert any(goal[:2] == pytest.approx((0.1, 0.1)) for goal in goals)
        assert env.task.draws == 20


def test_a_task_whose_draws_fail_at_first_is_accepted():
    with make(Failing()) as env:
        env.task.ready = True
        env.reset()


class WithItsOwnStart(GoalOfADrawer):
    def sample_start(self, rng):
        start = super().sample_start(rng)
        return start._replace(goal=self.sample_goal(rng))


def test_a_start_that_calls_the_override_is_accepted():
    with make(WithItsOwnStart()) as env:
        goal = env.reset()["desired_goal"]
        assert goal.tolist() == pytest.approx([0.0, 0.0, 0.06])


def test_a_function_of_an_object_is_called():
    task = Push()
    task.sample_goal = lambda rng: (0.1, 0.1, 0.02)
    with make(task) as env:
        assert env.reset()["desired_goal"].tolist() == pytest.approx([0.1, 0.1, 0.02])
