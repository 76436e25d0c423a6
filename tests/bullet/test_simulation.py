"""Results do not depend on the number of threads or on other load."""

import threading

import pytest
import torch

import torch_panda
from torch_panda.bullet import PhysicsClient, Scene, VectorSimulation

pytestmark = pytest.mark.usefixtures("loop")


def trajectory(num_envs, num_threads, steps):
    generator = torch.Generator().manual_seed(0)
    env = torch_panda.make(
        "PandaPush-v1", num_envs=num_envs, num_threads=num_threads, seed=1
    )
    with env:
        td, observations = env.reset(), []
        for _ in range(steps):
            towards = (td["achieved_goal"] - td["observation"][:, :3]) * 20
            noise = torch.randn(num_envs, 3, generator=generator)
            td["action"] = towards + noise * 0.3
            td = env.step(td)["next"]
            observations.append(td["observation"])
        return torch.stack(observations)


def test_many_threads_compute_the_same_numbers_as_one():
    assert torch.equal(trajectory(40, 40, 12), trajectory(40, 1, 12))


def test_load_from_another_thread_changes_nothing():
    stop = threading.Event()

    def busy():
        while not stop.is_set():
            sum(range(1000))

    thread = threading.Thread(target=busy)
    thread.start()
    try:
        loaded = trajectory(8, 2, 20)
    finally:
        stop.set()
        thread.join()
    assert torch.equal(loaded, trajectory(8, 2, 20))


def test_clients_must_have_the_same_scene():
    bodies = []

    def build(client: PhysicsClient) -> Scene:
        robot = client.create_sphere(0.1, mass=1.0, position=(0.0, 0.0, len(bodies)))
        bodies.append(robot)
        return Scene(robot, (), ee_link=len(bodies))

    with pytest.raises(torch_panda.BulletError, match="same in every client"):
        VectorSimulation(build, 2)
