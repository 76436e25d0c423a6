"""Steps in threads: equal numbers, errors that name environments, interrupts, forks."""

import dataclasses
import multiprocessing
import os
import signal
import sys
import threading
import time
from ctypes import c_int, c_void_p

import numpy as np
import pytest
import torch
from tensordict import TensorDict

import torch_panda
from torch_panda import Panda, PhysicsParams, Push, RobotTaskEnv, WorkerError
from torch_panda.bullet import (
    BulletError,
    MotorControl,
    Scene,
    VectorSimulation,
    capi,
    library,
)

N = 3

remove_body = library.bind(
    library.WORK, "b3InitRemoveBodyCommand", c_void_p, c_void_p, c_int
)


def make(env_id="PandaPush-v1", **options):
    options = {"num_envs": N, "num_threads": 2, "seed": 0, **options}
    return torch_panda.make(env_id, **options)


def own_threads():
    """Number of threads of this process, of Python and of C."""
    return len(os.listdir("/proc/self/task"))


@pytest.fixture
def env():
    with make() as env:
        yield env


def detections(env):
    return [client.num_detections for client in env.episodes.simulation.clients]


def test_an_arm_alone_steps_the_same_in_every_episode():
    """With a single body, the broad phase has no pair that resets its cursor."""

    def build(client):
        arm = client.load_urdf("franka_panda/panda.urdf", fixed_base=True)
        joints = [joint.number for joint in client.joints(arm) if joint.is_movable]
        return Scene(arm, tuple(joints), ee_link=11)

    simulation = VectorSimulation(build, N)
    positions = []
    for _episode in range(2):
        simulation.joint_position[:] = torch.linspace(-1, 0, N * 9).view(N, 9)
        simulation.joint_velocity[:] = 0.0
        simulation.reset(range(N))
        simulation.step(MotorControl((50.0,) * 9), np.zeros((N, 9)))
        positions.append(simulation.ee_position.clone())
    simulation.close()
    assert torch.equal(*positions)


# ---- errors --------------------------------------------------------------------------


def break_client(env, index):
    """Remove the robot from a client, so that Bullet refuses its commands."""
    simulation = env.episodes.simulation
    client = simulation.clients[index]
    handle = client.connection.handle
    capi.submit(handle, remove_body(handle, simulation.scene.robot))


def step(env):
    return env.step(TensorDict({"action": torch.ones(N, 3)}, [N]))["next"]


@pytest.mark.parametrize("broken", [(0,), (1,), (2, 1)])
def test_an_error_names_the_environment_and_the_others_go_on(env, broken):
    with make() as other:
        env.reset()
        other.reset()
        for index in broken:
            break_client(env, index)
        first = min(broken)
        message = (
            f"environment {first}: BulletError: Bullet could not solve the inverse "
            rf"kinematics: it answered with status \d+, expected 43"
        )
        with pytest.raises(WorkerError, match=message) as caught:
            step(env)
        assert caught.value.index == first
        assert isinstance(caught.value.__cause__, BulletError)
        step(other)
        alive = [k for k in range(N) if k not in broken]
        ours, theirs = env.get_state(), other.get_state()
        assert (ours[alive] == theirs[alive]).all()
    for index in broken:
        env.episodes.simulation.rebuild(index)
    assert env.rollout(5).shape == (N, 5)


def test_a_step_names_the_environment_of_a_closed_client(env):
    env.reset()
    env.episodes.simulation.clients[1].close()
    with pytest.raises(WorkerError, match=r"environment 1: BulletError: .* is closed"):
        step(env)


def test_a_failed_reset_names_its_environment_and_blocks_steps(env):
    with make() as other:
        env.reset()
        other.reset()
        break_client(env, 2)
        env.episodes.simulation.clients[1].close()
        with pytest.raises(WorkerError, match=r"environment 1: .* client is closed"):
            env.reset()
        env.episodes.simulation.rebuild(1)
        message = (
            r"environment 2: BulletError: Bullet could not load a state: it "
            r"answered with status 94, expected 95$"
        )
        with pytest.raises(WorkerError, match=message) as caught:
            env.reset()
        assert caught.value.index == 2
        for _ in range(2):
            other.reset()
        # The others were reset, but steps are refused until all environments are reset.
        for key in ("joint_position", "object_pose", "ee_position"):
            ours = getattr(env.episodes.simulation, key)[:2]
            theirs = getattr(other.episodes.simulation, key)[:2]
            assert torch.equal(ours, theirs)
        with pytest.raises(BulletError, match="last reset failed"):
            step(env)


@pytest.fixture(scope="module")
def checked():
    with make() as env:
        yield env


@pytest.mark.parametrize(
    ("changes", "size", "message"),
    [
        ({}, 4, r"must have shape \(3, 5\), got \(3, 4\)"),
        ({"forces": (1.0,) * 4}, 5, "a force for each of 9 movable joints, got 4"),
        ({"num_arm_joints": 0}, 12, "ik_link needs num_arm_joints"),
        ({"num_arm_joints": 12}, 5, "num_arm_joints must be .* got 12"),
        ({"ik_link": -1}, 5, "ik_link must be .* got -1"),
    ],
)
def test_a_control_that_does_not_fit_the_robot_is_refused(
    checked, changes, size, message
):
    """C code would read beyond the end of an array."""
    control = dataclasses.replace(checked.robot.motor_control, **changes)
    with pytest.raises(ValueError, match=message):
        checked.episodes.simulation.step(control, np.zeros((N, size)))


@pytest.mark.parametrize("envs", [[N], [-1], [0, 1, 0]])
def test_clients_that_do_not_exist_or_are_named_twice_are_refused(checked, envs):
    simulation, control = checked.episodes.simulation, checked.robot.motor_control
    setpoint = np.zeros((N, control.setpoint_dim))
    for call in (
        lambda: simulation.step(control, setpoint, envs),
        lambda: simulation.reset(envs),
    ):
        with pytest.raises(ValueError, match="different indices from 0 to 2, got"):
            call()


# ---- interrupts, processes, threads --------------------------------------------------


def test_a_step_is_finished_before_an_interrupt_is_raised():
    physics = PhysicsParams(n_substeps=200)
    with make(physics=physics) as env:
        env.reset()
        before = detections(env)
        main = threading.main_thread().ident

        def interrupt():
            while detections(env) == before:  # the step has not begun
                time.sleep(1e-4)
            signal.pthread_kill(main, signal.SIGINT)

        thread = threading.Thread(target=interrupt)
        thread.start()
        with pytest.raises(KeyboardInterrupt):
            step(env)
        thread.join()
        assert detections(env) == [count + 200 for count in before]
        assert env.get_state()["step_count"].flatten().tolist() == [1] * N
        with make(physics=physics) as other:
            other.reset()
            step(other)
            assert (env.get_state() == other.get_state()).all()


def test_a_forked_child_has_threads_of_its_own(env):
    env.reset()
    first = step(env)["observation"].tolist()
    receiver, sender = multiprocessing.Pipe(duplex=False)

    def observe():
        steps = [step(env)["observation"].tolist() for _ in range(3)]
        return [*steps, env.reset()["observation"].tolist()]

    def child():
        sender.send(observe())
        env.close()
        with make() as own:
            own.reset()
            sender.send(step(own)["observation"].tolist())

    process = multiprocessing.get_context("fork").Process(target=child)
    process.start()
    try:
        assert receiver.poll(60)
        theirs = receiver.recv()
        assert receiver.poll(60)
        assert receiver.recv() == first
        process.join(60)
        assert process.exitcode == 0
    finally:
        process.kill()
    assert observe() == theirs


@pytest.mark.skipif(sys.platform != "linux", reason="counts threads in /proc")
def test_no_thread_is_left_after_close():
    before = own_threads()
    with make() as env:
        env.rollout(3)
        assert own_threads() > before
    deadline = time.monotonic() + 10
    while own_threads() > before:  # a joined thread may still be listed
        assert time.monotonic() < deadline


def test_denormal_numbers_are_not_flushed_to_zero():
    """torch's setting for the caller's thread must not affect physics."""
    tiny = 1e-310  # [m/s]
    torch.set_flush_denormal(True)
    try:
        with make() as env:
            env.reset()
            state = env.get_state()
            state["object_pose"][:, 0, 2] = 0.5  # in free fall
            state["object_velocity"][:, 0, 0] = tiny
            env.reset(state, set_state=True)
            step(env)
            velocity = env.get_state()["object_velocity"][:, 0, 0]
    finally:
        torch.set_flush_denormal(False)
    assert (velocity > 0).all()
    assert (velocity < tiny).all()  # Bullet damps the velocity


# ---- controls in Python --------------------------------------------------------------


class OwnControl(Panda):
    """A robot whose control is written in Python."""

    num_controlled = 0

    def control(self, client, body, setpoint):
        self.num_controlled += 1
        super().control(client, body, setpoint)


def test_a_robots_own_control_is_called():
    robots = OwnControl(block_gripper=True), Panda(block_gripper=True)
    states = []
    for robot in robots:
        with RobotTaskEnv(robot=robot, task=Push(), num_envs=N, seed=0) as env:
            env.rollout(4, lambda td: td.set("action", torch.ones(N, 3)))
            states.append(env.get_state())
    assert (states[0] == states[1]).all()
    assert robots[0].num_controlled == 4 * N


def test_a_robots_own_control_cannot_use_torques():
    """They would act in the first substep only."""
    robot = OwnControl(block_gripper=True, control_type="joint_torque")
    with RobotTaskEnv(robot=robot, task=Push(), num_envs=2, num_threads=1) as env:
        env.reset()
        with pytest.raises(WorkerError, match=r"environment 0: ValueError: .* torq"):
            env.step(env.rand_action())
