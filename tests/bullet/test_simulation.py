"""A reset of a simulation puts every body where the tensors say, in its own client."""

import torch

from torch_panda.bullet import Scene, VectorSimulation

N = 3


def build(client):
    arm = client.load_urdf("franka_panda/panda.urdf", fixed_base=True)
    joints = [joint.number for joint in client.joints(arm) if joint.is_movable]
    cubes = [
        client.create_box((0.02,) * 3, mass=1.0, position=(k, 1, 1)) for k in (1, 2)
    ]
    markers = [client.create_marker((k, 2, 1)) for k in (1, 2)]
    return Scene(
        arm,
        tuple(joints),
        ee_link=11,
        objects=tuple(cubes),
        object_joints=((), ()),
        markers=tuple(markers),
    )


def test_a_reset_places_every_body_of_every_client():
    generator = torch.Generator().manual_seed(0)

    def draw(like):
        return torch.rand(like.shape, generator=generator, dtype=torch.float64)

    simulation = VectorSimulation(build, N)
    scene = simulation.scene
    drawn = {
        name: draw(getattr(simulation, name))
        for name in ("joint_position", "joint_velocity", "object_pose", "marker_pose")
    }
    drawn["object_velocity"] = draw(simulation.object_velocity)
    for name in ("object_pose", "marker_pose"):
        rotations = drawn[name][..., 3:]
        rotations /= rotations.norm(dim=-1, keepdim=True)
    for name, values in drawn.items():
        getattr(simulation, name)[:] = values
    simulation.reset(range(N))
    for env, client in enumerate(simulation.clients):
        robot = client.state(scene.robot)
        assert robot.joint_positions.tolist() == drawn["joint_position"][env].tolist()
        assert robot.joint_velocities.tolist() == drawn["joint_velocity"][env].tolist()
        for name, bodies in (
            ("object_pose", scene.objects),
            ("marker_pose", scene.markers),
        ):
            poses = [client.state(body).base_pose.tolist() for body in bodies]
            torch.testing.assert_close(
                torch.tensor(poses, dtype=torch.float64), drawn[name][env]
            )
        velocities = [
            client.state(body).base_velocity.tolist() for body in scene.objects
        ]
        assert velocities == drawn["object_velocity"][env].tolist()
        for body in scene.markers:
            assert not client.state(body).base_velocity.any()
    # The tensors hold what Bullet reports.
    torch.testing.assert_close(simulation.object_pose, drawn["object_pose"])
    simulation.close()
