"""Setpoints, observations, success and reward from C equal those from torch."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import _StepMDP

import torch_panda
from torch_panda import Panda, Push, RobotTaskEnv, Task
from torch_panda.bullet import native, selects_state
from torch_panda.bullet.selection import selected_columns
from torch_panda.envs.compiled_observer import CompiledObserver
from torch_panda.robots.compiled_setpoints import CompiledSetpoints

pytestmark = pytest.mark.skipif(
    native.LIBRARY is None, reason="installed where there was no C compiler"
)

N = 3
IDS = (
    "PandaReach-v1",
    "PandaReachJointsDense-v3",
    "PandaPush-v3",
    "PandaPushDense-v1",
    "PandaSlideJoints-v3",
    "PandaPickAndPlace-v1",
    "PandaPickAndPlaceJoints-v3",
    "PandaStack-v1",
    "PandaStackDense-v3",
    "PandaFlip-v3",
    "PandaFlipDense-v1",
)


def without_c(monkeypatch):
    monkeypatch.setattr(CompiledObserver, "make", lambda *_, **__: None)
    monkeypatch.setattr(CompiledSetpoints, "applies", lambda *_: False)


def act(env, steps):
    """Observations of steps with actions in and out of range, and of partial resets."""
    generator, observed = torch.Generator().manual_seed(0), [env.reset()]
    for _ in range(steps):
        td = observed[-1].exclude("action", "next")
        td["action"] = torch.rand(env.action_spec.shape, generator=generator) * 3 - 1.5
        _, td = env.step_and_maybe_reset(td)
        observed.append(td)
    return observed


def assert_same_bits(ours, theirs):
    assert ours.keys() == theirs.keys()
    for key, value in ours.items():
        other = theirs[key]
        assert value.dtype == other.dtype
        assert value.shape == other.shape
        assert value.is_contiguous()
        if value.dtype == torch.float32:  # also the signs of zeros
            value, other = value.view(torch.int32), other.view(torch.int32)
        assert value.equal(other), key


@pytest.mark.parametrize(
    ("env_id", "num_envs"),
    [
        *((env_id, N) for env_id in IDS),
        ("PandaPickAndPlaceJoints-v3", None),
        ("PandaStackDense-v3", None),
    ],
)
def test_steps_from_c_have_the_bits_of_steps_from_torch(monkeypatch, env_id, num_envs):
    options = {"num_envs": num_envs, "seed": 1, "max_episode_steps": 7}
    with torch_panda.make(env_id, **options) as env:
        assert env.episodes._compiled_setpoints is not None
        assert env.episodes._observer._compiled is not None
        ours = act(env, 16)
    without_c(monkeypatch)
    with torch_panda.make(env_id, **options) as env:
        assert env.episodes._compiled_setpoints is None
        assert env.episodes._observer._compiled is None
        theirs = act(env, 16)
    for one, other in zip(ours, theirs, strict=True):
        assert_same_bits(one, other)


def test_distances_near_the_threshold_are_left_to_torch():
    """The goal is moved by the threshold and by a few float32 more or less."""
    generator = torch.Generator().manual_seed(0)
    with torch_panda.make("PandaPush-v3", num_envs=64, seed=0) as env:
        env.reset()
        observer, goal = env.episodes._observer, env.episodes._starts.goal
        steps = torch.ones(64, 1, dtype=torch.int64)
        achieved = env.task.achieved_goal(env.episodes.simulation)
        rest, successes = 0, 0
        for _ in range(200):
            direction = torch.randn(64, 3, generator=generator).double()
            direction /= direction.norm(dim=1, keepdim=True)
            factor = 1 + 1e-6 * torch.randn(64, 1, generator=generator).double()
            goal[:] = achieved + env.task.distance_threshold * factor * direction
            _, is_complete = observer._compiled.observe(goal, steps)
            rest += not is_complete
            observed = observer.observe(goal, steps, torch.zeros(64, 3))
            goals = observed["achieved_goal"], observed["desired_goal"]
            assert observed["success"].equal(env.is_success(*goals))
            assert observed["reward"].equal(env.compute_reward(*goals))
            assert observed["done"].equal(observed["success"])
            successes += int(observed["success"].sum())
        assert rest == 200
        assert 0.3 < successes / (200 * 64) < 0.7


@pytest.mark.parametrize("threshold", [0.0, 1e-30, 0.04, 1.0, 1e30])
def test_success_follows_a_threshold_of_any_size_that_changes_later(threshold):
    with torch_panda.make("PandaPush-v3", num_envs=N, seed=0) as env:
        env.task.distance_threshold = threshold
        for td in act(env, 3)[1:]:
            goals = td["achieved_goal"], td["desired_goal"]
            assert td["success"].equal(env.is_success(*goals))
        env.episodes._starts.goal[:] = env.get_state()["object_pose"][:, 0, :3]
        td = env.step(td.set("action", torch.zeros(N, 3)))["next"]
        goals = td["achieved_goal"], td["desired_goal"]
        assert td["success"].equal(env.is_success(*goals))
        assert td["reward"].equal(env.compute_reward(*goals))


class FarPush(Push):
    """Its own achieved goal and success, which C must not replace."""

    goal_entries = None

    def achieved_goal(self, simulation):
        return super().achieved_goal(simulation) + 1.0

    def success_distance(self, achieved_goal, desired_goal):
        return self.distance(achieved_goal, desired_goal + 1.0)


class OwnRobot(Panda):
    def arm_setpoint(self, action, simulation):
        return super().arm_setpoint(-action, simulation)

    def observation(self, simulation):
        return -super().observation(simulation)


def make(task=None, robot=None):
    robot, task = robot or Panda(block_gripper=True), task or Push()
    return RobotTaskEnv(robot=robot, task=task, num_envs=N, seed=0)


def test_c_does_not_replace_functions_of_a_users_task():
    action = torch.ones(N, 3)
    with make() as env, make(FarPush()) as far:
        step, step_far = (
            e.step(e.reset().set("action", action))["next"] for e in (env, far)
        )
        moved = step["achieved_goal"].double() + 1.0
        assert step_far["achieved_goal"].allclose(moved.float())
        assert step_far["success"].equal(step["success"])


def test_c_does_not_replace_functions_of_a_users_robot():
    action = torch.ones(N, 3)
    with make() as env, make(robot=OwnRobot(block_gripper=True)) as own:
        step = env.step(env.reset().set("action", action))["next"]
        other = own.step(own.reset().set("action", -action))["next"]
        expected = step["observation"].clone()
        expected[:, :6] *= -1
        assert other["observation"].equal(expected)


def test_a_wrong_selects_state_is_refused():
    class Doubled(Push):
        @selects_state
        def observation(self, simulation):
            return 2 * super().observation(simulation)

    with make() as env:
        simulation = env.episodes.simulation
        rows = simulation.state.rows.clone()
        assert selected_columns(Task.distance.__get__(env.task), simulation) is None
        with pytest.raises(ValueError, match="declared by selects_state, so it must"):
            selected_columns(Doubled().observation, simulation)
        assert simulation.state.rows.equal(rows)


def test_the_callers_action_is_kept_and_not_changed():
    with make() as env:
        start = env.reset()
        action = torch.full((N, 3), 2.0)
        env.step(start.set("action", action))
        assert (action == 2.0).all()
        action.zero_()
        state = env.get_state(exact=True)
        assert (state["actions"] == 1.0).all()


# ---- the next root of a rollout ------------------------------------------------------


def assert_same_next_root(env, td):
    ours = env._step_mdp(td)
    theirs = _StepMDP(env, exclude_action=False)(td)
    assert type(ours) is type(theirs)
    assert (ours.batch_size, ours.device) == (theirs.batch_size, theirs.device)
    assert ours.names == theirs.names
    assert list(ours.keys()) == list(theirs.keys())
    for key, value in ours.items():
        if isinstance(value, torch.Tensor):
            assert value is theirs[key]
        else:
            assert (value == theirs[key]).all()
            assert value is not td[key]
    return ours


def test_the_next_root_is_that_of_torchrl():
    with make() as env:
        td = env.reset().set("action", torch.ones(N, 3))
        td["hidden"] = torch.ones(N, 2)  # of a policy
        td = env.step(td)
        root = assert_same_next_root(env, td)
        assert "hidden" in set(root.keys())
        assert "reward" not in set(root.keys())
        td["next", "hidden"] = torch.zeros(N, 2)  # not an observation
        assert (assert_same_next_root(env, td)["hidden"] == 1).all()
        td["nested"] = TensorDict({"entry": torch.ones(N)}, [N])
        assert_same_next_root(env, td)
        td.names = ["envs"]
        assert_same_next_root(env, td.exclude("nested"))
        assert_same_next_root(env, td.exclude("done", ("next", "done")))
        env.add_truncated_keys()  # clears torchrl's cache
        assert_same_next_root(env, td)


@pytest.mark.parametrize("layout", ["plain", "strided", "missing"])
def test_ends_are_found_and_marked_as_by_torchrl(layout):
    with make() as env:
        td = env.reset()
        for env_index in (None, 0, N - 1):
            done = torch.zeros(N, 2, dtype=torch.bool)[:, :1]
            if layout != "strided":
                done = done.contiguous()
            if env_index is not None:
                done[env_index] = True
            root = td.exclude("done", "_reset")
            if layout != "missing":
                root["done"] = done
            expected = layout != "missing" and env_index is not None
            assert env.any_done(root) == expected
            assert ("_reset" in set(root.keys())) == expected
            if expected:
                assert root["_reset"].equal(done)


def test_a_step_refuses_a_locked_tensordict():
    with make() as env:
        td = env.reset().set("action", torch.ones(N, 3)).lock_()
        with pytest.raises(RuntimeError, match="locked"):
            env.step(td)
