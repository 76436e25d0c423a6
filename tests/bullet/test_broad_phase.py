"""A reset restores the broad phase: earlier steps have no effect on later ones."""

import contextlib
import random

import pytest
import torch

from torch_panda.bullet import PhysicsClient, Scene, VectorSimulation

CUBE = (0.02, 0.02, 0.02)


def poses(client):
    """Poses of the bases, joints and links of all bodies."""
    numbers = []
    for body in client.bodies:
        state = client.state(body)
        numbers.append(state.base_pose.tolist())
        numbers.append(state.joint_positions.tolist())
        numbers.append(state.link_poses.tolist())
    return numbers


def build_arm(client, position=(0.0, 0.0, 0.0)):
    return client.load_urdf(
        "franka_panda/panda.urdf", position=position, fixed_base=True
    )


def build_cubes(client, starts):
    client.create_box((1.0, 1.0, 0.1), mass=0.0, position=(0.0, 0.0, -0.1))
    return [client.create_box(CUBE, mass=1.0, position=start) for start in starts]


def describe(client, arm, cubes):
    joints = [joint.number for joint in client.joints(arm) if joint.is_movable]
    return Scene(
        arm,
        tuple(joints),
        ee_link=11,
        objects=tuple(cubes),
        object_joints=((),) * len(cubes),
    )


def reset(simulation, starts, velocities):
    simulation.joint_position[:] = 0.0
    simulation.joint_velocity[:] = 0.0
    simulation.object_pose[0, :, :3] = torch.tensor(starts, dtype=torch.float64)
    simulation.object_pose[0, :, 3:] = torch.tensor((0.0, 0.0, 0.0, 1.0))
    simulation.object_velocity[:] = 0.0
    simulation.object_velocity[0, :, :3] = torch.tensor(velocities)
    simulation.reset([0])


@pytest.fixture
def simulate():
    """Make simulations of one client that are closed after the test."""
    with contextlib.ExitStack() as stack:

        def make(build):
            simulation = VectorSimulation(build, 1)
            stack.callback(simulation.close)
            return simulation, simulation.clients[0]

        yield make


def test_steps_after_a_reset_equal_those_of_a_new_client(simulate):
    starts = [(0.5, 0.0, 0.02 + 0.04 * k) for k in range(6)]

    def build(client):
        arm = build_arm(client)
        return describe(client, arm, build_cubes(client, starts))

    def sweep(client, arm):
        contacts = []
        client.set_joints(arm, (0, 1, 3, 5), (-0.5, 0.6, -2.0, 2.6), (2.0, 0.5, 0, 0))
        for _ in range(200):
            client.step()
            contacts.append(client.contact_points())
        return poses(client), contacts

    with PhysicsClient() as new:
        expected = sweep(new, build(new).robot)
    simulation, client = simulate(build)
    arm, cubes = simulation.scene.robot, simulation.scene.objects
    phases = set()
    for num_steps in (0, 7, 40, 300):
        client.set_joint(arm, 1, 1.2, 0.5)
        for k, cube in enumerate(cubes):
            start = (0.4, 0.01 * k, 0.1 + 0.05 * k)
            client.set_base(cube, start, (0.0, 0.6, 0.0, 0.8))
        client.step(num_steps)
        reset(simulation, starts, (0.0, 0.0, 0.0))
        phases.add(client.num_detections % 256)
        assert sweep(client, arm) == expected
    # The low bits of this number choose the leaf that the next detection reinserts.
    assert len(phases) == 1


def test_cubes_that_fly_apart_repeat_their_flight(simulate):
    """The cursor in the list of pairs is a part of the state, too.

    It matters in few flights, and in this one from the second reset on.
    """
    rng = random.Random(0)
    starts, velocities = [], []
    for _ in range(40):
        x, y = rng.uniform(0.0, 0.3), rng.uniform(0.0, 0.3)
        starts.append((x, y, rng.uniform(0.05, 0.3)))
        velocities.append([rng.uniform(-3.0, 3.0) for _ in range(3)])

    def build(client):
        cubes = build_cubes(client, starts)
        return describe(client, build_arm(client, (5.0, 5.0, 0.0)), cubes)

    simulation, client = simulate(build)
    ends = []
    for _ in range(4):
        reset(simulation, starts, velocities)
        client.step(300)
        ends.append(poses(client))
        for cube in simulation.scene.objects:
            client.set_base(cube, [0.3 * rng.random() for _ in range(3)])
        client.step(rng.randrange(1, 200))
    assert all(end == ends[0] for end in ends)


def test_a_reset_keeps_the_collision_filters_of_the_scene(simulate):
    starts = [(0.9, 0.0, 0.05), (0.9, 0.5, 0.05)]

    def build(client):
        arm = build_arm(client)
        cubes = build_cubes(client, starts)
        client.set_collision_filter(cubes[0], -1, 0, 0)
        return describe(client, arm, cubes)

    simulation, client = simulate(build)
    reset(simulation, starts, (0.0, 0.0, 0.0))
    client.step(200)
    heights = [client.state(cube).base_pose[2] for cube in simulation.scene.objects]
    assert heights[0] < -0.1  # the first cube touches nothing and falls
    assert heights[1] == pytest.approx(0.02, abs=1e-3)
