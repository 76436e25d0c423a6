"""After a reset that failed, its environments need another reset."""

import sys

import pytest
import torch

import torch_panda
from torch_panda import BulletError, Panda, Push, Reach, RobotTaskEnv
from torch_panda.bullet.pool import WorkerError


class FailsOnce(Reach):
    fails = True

    def sample_goal(self, rng):
        if self.fails:
            self.fails = False
            raise RuntimeError("no goal yet")
        return super().sample_goal(rng)


class FailsInTheThirdEpisode(Push):
    calls = 0

    def randomize(self, client, bodies, rng):
        self.calls += 1
        if self.calls == 3:
            raise RuntimeError("boom")


def make(task, **options):
    robot = Panda(block_gripper=True)
    return RobotTaskEnv(robot=robot, task=task, num_threads=1, seed=0, **options)


def test_environments_recover_from_a_start_that_cannot_be_drawn():
    with make(FailsOnce()) as env:
        with pytest.raises(RuntimeError, match="no goal yet"):
            env.reset()
        with pytest.raises(BulletError, match=r"environments \[0\] .*reset first"):
            env.step(env.rand_action())
        assert env.rollout(3).shape == (3,)


def test_environments_recover_from_physics_that_cannot_be_varied():
    with make(FailsInTheThirdEpisode(), num_envs=2) as env:
        env.rollout(5)
        mask = torch.tensor([[True], [False]])
        with pytest.raises(WorkerError, match="environment 0: RuntimeError: boom"):
            env.reset(env.rand_action().set("_reset", mask))
        with pytest.raises(BulletError, match=r"environments \[0\] .*reset failed"):
            env.step(env.rand_action())
        # A reset of another environment also resets this one.
        env.reset(env.rand_action().set("_reset", ~mask))
        exact = env.get_state(exact=True)
        env.reset(exact, set_state=True)


def test_environments_recover_from_a_divergence_without_a_next_start():
    task = FailsOnce()
    task.fails = False
    with make(task, on_divergence="reset") as env:
        env.reset()
        simulation = env.episodes.simulation
        scene = simulation.scene
        simulation.clients[0].set_joint(scene.robot, scene.joints[0], 0.0, 1e300)
        task.fails = True
        with pytest.raises(RuntimeError, match="no goal yet"):
            env.step(env.rand_action())
        with pytest.raises(BulletError, match=r"environments \[0\] .*reset first"):
            env.step(env.rand_action())
        assert env.rollout(3).shape == (3,)


class Exits(Push):
    def randomize(self, client, bodies, rng):
        sys.exit("no such mass")


def test_a_hook_that_exits_raises_an_error():
    message = "environment 0: SystemExit: no such mass"
    with make(Exits()) as env, pytest.raises(WorkerError, match=message):
        env.reset()


class Driver(Panda):
    broken = None

    def control(self, client, body, setpoint):
        if client is self.broken:
            raise RuntimeError("motor")
        super().control(client, body, setpoint)


def make_driven():
    robot, options = Driver(block_gripper=True), {"num_threads": 1, "seed": 0}
    return RobotTaskEnv(robot=robot, task=Push(), num_envs=2, **options)


def fail_and_diverge(env):
    """A step in which a motor of environment 0 fails and environment 1 diverges."""
    simulation = env.episodes.simulation
    scene = simulation.scene
    env.robot.broken = simulation.clients[0]
    simulation.clients[1].set_joint(scene.robot, scene.joints[0], 0.0, 1e300)
    with pytest.raises(WorkerError, match="environment 0: RuntimeError: motor"):
        env.step(env.rand_action())
    env.robot.broken = None


def test_a_reset_of_others_leaves_a_divergence_to_be_found():
    with make_driven() as env:
        env.reset()
        fail_and_diverge(env)
        env.reset(env.rand_action().set("_reset", torch.tensor([[True], [False]])))
        with pytest.raises(BulletError, match=r"environments \[1\] diverged"):
            env.step(env.rand_action())


def test_a_reset_rebuilds_a_diverged_client_that_no_error_named():
    with make_driven() as env, make_driven() as fresh:
        env.reset(), fresh.reset()
        fail_and_diverge(env)
        actions = torch.ones(2, 3)
        actual = [
            e.step(e.reset().set("action", actions))["next", "observation"]
            for e in (env, fresh)
        ]
        assert torch.equal(*actual)


def test_a_diverged_step_does_not_count_as_success():
    options = {"seed": 0, "on_divergence": "reset"}
    solved = 0
    with torch_panda.make("PandaPush-v3", **options) as env:
        simulation = env.episodes.simulation
        robot, joint = simulation.scene.robot, simulation.scene.joints[0]
        for _ in range(8):
            env.reset()
            simulation.clients[0].set_joint(robot, joint, 0.0, 1e300)
            after = env.step(env.rand_action())["next"]
            goals = after["achieved_goal"], after["desired_goal"]
            solved += int(env.is_success(*goals))
            ends = [after[key].item() for key in ("success", "terminated", "truncated")]
            assert ends == [False, False, True]
            assert after["done"]
    assert solved  # some of these states would have counted as success


class Stutters(Panda):
    fails = False

    def setpoint(self, action, simulation):
        if self.fails:
            raise RuntimeError("no setpoint")
        return super().setpoint(action, simulation)


def test_a_step_without_a_setpoint_was_not_taken():
    robot = Stutters(block_gripper=True)
    with RobotTaskEnv(robot=robot, task=Reach(), num_envs=1, seed=0) as env:
        td = env.reset().set("action", torch.ones(1, 3))
        robot.fails = True
        with pytest.raises(RuntimeError, match="no setpoint"):
            env.step(td)
        robot.fails = False
        after = env.step(td)["next", "observation"]
        state = env.get_state(exact=True)
        assert state["step_count"].tolist() == [[1]]
        env.reset()
        again = env.reset(state, set_state=True)["observation"]
        assert torch.equal(again, after)
