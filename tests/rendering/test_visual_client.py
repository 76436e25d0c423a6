"""Pictures of a visual client equal those of the pybullet module."""

import numpy as np
import pybullet
import pytest

from torch_panda.bullet import BulletError, PhysicsClient, Visual
from torch_panda.bullet.shapes import Box
from torch_panda.rendering.camera import Camera, resized, to_metres
from torch_panda.rendering.visual_client import VisualClient

BLUE, RED = (0.1, 0.2, 0.9), (0.8, 0.1, 0.1)
CAMERA = Camera(
    target=(0.1, 0.0, 0.05),
    distance=1.1,
    yaw=30,
    pitch=-40,
    roll=5,
    width=93,
    height=61,
)


def visual_client(build, layer="solids"):
    """A visual client of the scene that a function builds."""
    with PhysicsClient() as client:
        build(client)
        return VisualClient(client.blueprint, layer)


def build(client):
    client.create_box((1, 1, 0.1), mass=0, position=(0, 0, -0.1), visual=Visual(BLUE))
    client.create_cylinder(
        0.1, 0.3, mass=1, position=(0.2, 0, 0.15), visual=Visual(RED)
    )
    client.create_sphere(0.15, mass=1, position=(-0.1, 0.2, 0.15))
    client.create_marker((0, -0.2, 0.2), Box((0.1, 0.1, 0.1)), visual=Visual(BLUE))


def build_reference(p):
    shapes = (
        (p.GEOM_BOX, {"halfExtents": (1, 1, 0.1)}, BLUE, (0, 0, -0.1)),
        (p.GEOM_CYLINDER, {"radius": 0.1, "length": 0.3}, RED, (0.2, 0, 0.15)),
        (p.GEOM_SPHERE, {"radius": 0.15}, (0.1, 0.9, 0.1), (-0.1, 0.2, 0.15)),
    )
    for geometry, size, color, position in shapes:
        shape = p.createVisualShape(geometry, rgbaColor=(*color, 1), **size)
        p.createMultiBody(baseVisualShapeIndex=shape, basePosition=position)


@pytest.mark.parametrize("shadow", [True, False])
def test_pictures_equal_those_of_pybullet(shadow):
    reference = pybullet.connect(pybullet.DIRECT)
    build_reference(pybullet)
    view = pybullet.computeViewMatrixFromYawPitchRoll(
        (0.1, 0, 0.05), 1.1, 30, -40, 5, 2
    )
    projection = pybullet.computeProjectionMatrixFOV(60, 93 / 61, 0.1, 100)
    _, _, rgba, depth, segmentation = pybullet.getCameraImage(
        93, 61, view, projection, shadow=shadow
    )
    pybullet.disconnect(reference)
    with visual_client(build) as client:
        image = client.render(CAMERA, segmentation=True, shadow=shadow)
        assert image.rgb.shape == (61, 93, 3)
        np.testing.assert_array_equal(image.rgb, np.reshape(rgba, (61, 93, 4))[..., :3])
        np.testing.assert_array_equal(image.depth, np.reshape(depth, (61, 93)))
        ids = np.reshape(segmentation, (61, 93))
        np.testing.assert_array_equal(image.segmentation, ids)
        assert set(np.unique(ids)) == {-1, 0, 1, 2}


def test_every_layer_shows_its_own_bodies_under_the_same_ids():
    seen = {"solids": {-1, 0, 1, 2}, "markers": {-1, 3}, "all": {-1, 0, 1, 2, 3}}
    for layer, expected in seen.items():
        with visual_client(build, layer) as client:
            image = client.render(CAMERA, segmentation=True)
            assert set(np.unique(image.segmentation)) == expected


def test_bodies_that_were_moved_while_building_are_rendered_there():
    def build_and_move(client):
        arm = client.load_urdf("franka_panda/panda.urdf", fixed_base=True)
        box = client.create_box((0.1,) * 3, mass=1, position=(0, 0, 9))
        client.set_joint(arm, 1, 0.8, 0.0)
        client.set_base(box, (0.2, 0.3, 0.1), (0, 0, 0.6, 0.8))
        client.finish_building()
        client.set_joint(arm, 1, 0.0, 0.0)  # after building: not in the blueprint

    def reference(client):
        arm = client.load_urdf("franka_panda/panda.urdf", fixed_base=True)
        client.create_box((0.1,) * 3, mass=1, position=(0.2, 0.3, 0.1))
        client.set_base(1, (0.2, 0.3, 0.1), (0, 0, 0.6, 0.8))
        client.set_joints(arm, (1,), (0.8,), (0.0,))

    pictures = []
    for function in (build_and_move, reference):
        with visual_client(function) as client:
            image = client.render(CAMERA, segmentation=True)
            pictures.append([array.copy() for array in image])
    for ours, theirs in zip(*pictures, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert {0, 1} <= set(np.unique(pictures[0][2]))


def test_depth_is_converted_to_metres():
    camera = Camera(
        target=(0, 0, 0), distance=2.0, yaw=0, pitch=-90, height=32, width=32
    )

    def build_box(client):
        client.create_box((0.3, 0.3, 0.25), mass=0, position=(0, 0, 0))

    with visual_client(build_box) as client:
        depth = to_metres(client.render(camera).depth, camera)
    assert depth[16, 16] == pytest.approx(1.75, abs=1e-4)
    assert depth[0, 0] == camera.far


def test_a_size_is_a_number_or_height_and_width():
    assert resized(Camera(), (30, 40)) == Camera(height=30, width=40)
    assert resized(Camera(), 50) == Camera(height=50, width=50)


def test_a_missing_texture_is_named(tmp_path):
    visual = Visual(texture=tmp_path / "none.png")

    def build_box(client):
        client.create_box((1, 1, 1), mass=0, position=(0, 0, 0), visual=visual)

    with pytest.raises(BulletError, match=r"none\.png"):
        visual_client(build_box)
