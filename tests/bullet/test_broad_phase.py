"""Restoring the broad phase: bodies return, and earlier steps have no effect."""

import random

import pytest

from torch_panda.bullet import PhysicsClient
from torch_panda.bullet.broad_phase import BroadPhase

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


def test_steps_after_a_restore_equal_those_of_a_new_client():
    def build(client):
        client.load_urdf("franka_panda/panda.urdf", fixed_base=True)
        client.create_box((1.0, 1.0, 0.1), mass=0.0, position=(0.0, 0.0, -0.1))
        for k in range(6):
            client.create_box(CUBE, mass=1.0, position=(0.5, 0.0, 0.02 + 0.04 * k))
        client.create_marker((0.5, 0.0, 0.1))

    def disturb(client, num_steps):
        arm, _, *cubes, marker = client.bodies
        client.set_joint(arm, 1, 1.2, 0.5)
        client.set_base(marker, (0.3, 0.1, 0.2))
        for k, cube in enumerate(cubes):
            start = (0.4, 0.01 * k, 0.1 + 0.05 * k)
            client.set_base(cube, start, (0.0, 0.6, 0.0, 0.8))
        client.step(num_steps)

    def sweep(client):
        arm, contacts = client.bodies[0], []
        client.set_joints(arm, (0, 1, 3, 5), (-0.5, 0.6, -2.0, 2.6), (2.0, 0.5, 0, 0))
        for _ in range(200):
            client.step()
            contacts.append(client.contact_points())
        return poses(client), contacts

    with PhysicsClient() as new, PhysicsClient() as used:
        build(new)
        build(used)
        expected = sweep(new)
        broad_phase = BroadPhase(used)
        for num_steps in (0, 7, 40, 300):
            disturb(used, num_steps)
            broad_phase.restore()
            assert sweep(used) == expected


@pytest.mark.parametrize("seed", range(4))
def test_cubes_that_fly_apart_repeat_their_flight(seed):
    """The cursor in the list of pairs is a part of the state, too."""
    rng = random.Random(seed)
    starts = [(0.1 * (k % 4), 0.1 * (k // 4), 0.03) for k in range(12)]
    velocities = [
        (rng.uniform(-2, 2), rng.uniform(-2, 2), rng.random()) for _ in starts
    ]
    with PhysicsClient() as client:
        client.create_box((1.0, 1.0, 0.1), mass=0.0, position=(0.0, 0.0, -0.1))
        cubes = [client.create_box(CUBE, mass=1.0, position=start) for start in starts]
        broad_phase = BroadPhase(client)
        ends = []
        for _ in range(8):
            broad_phase.restore()
            for cube, start, velocity in zip(cubes, starts, velocities, strict=True):
                client.set_base(cube, start, linear_velocity=velocity)
            client.step(200)
            ends.append(poses(client))
            for cube in cubes:
                client.set_base(cube, [0.3 * rng.random() for _ in range(3)])
            client.step(rng.randrange(1, 200))
    assert all(end == ends[0] for end in ends)


def test_restore_keeps_the_collision_filters_of_the_scene():
    with PhysicsClient() as client:
        client.create_box((1.0, 1.0, 0.1), mass=0.0, position=(0.0, 0.0, -0.1))
        cubes = [
            client.create_box(CUBE, mass=1.0, position=(x, 0.0, 0.05)) for x in (0, 0.5)
        ]
        client.set_collision_filter(cubes[0], -1, 0, 0)
        client.finish_building()
        broad_phase = BroadPhase(client)
        broad_phase.restore()
        client.step(200)
        heights = [client.state(cube).base_pose[2] for cube in cubes]
    assert heights[0] < -0.1  # the first cube touches nothing and falls
    assert heights[1] == pytest.approx(0.02, abs=1e-3)
