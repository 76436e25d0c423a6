"""Coarse meshes: fewer triangles, the same picture."""

import numpy as np

from torch_panda.bullet import PhysicsClient
from torch_panda.bullet.urdf import find_urdf
from torch_panda.rendering import Camera
from torch_panda.rendering.mesh_decimation import decimated_urdf
from torch_panda.rendering.visual_client import VisualClient


def test_the_arm_looks_the_same_from_afar():
    camera = Camera(target=(0, 0, 0.4), distance=1.4, width=64, height=64)
    images = []
    for cell in (0.0, 0.013):
        with PhysicsClient() as physics:
            arm = physics.load_urdf("franka_panda/panda.urdf", fixed_base=True)
            physics.set_joints(arm, (1, 3, 5), (0.41, -1.85, 2.26), (0.0,) * 3)
        with VisualClient(physics.blueprint, mesh_cell=cell) as client:
            image = client.draw(camera, segmentation=True)
            images.append((image.rgb.astype(int), image.segmentation == arm))
    (fine, is_arm), (coarse, is_coarse_arm) = images
    assert is_arm.sum() > 200
    # Vertices move by at most half a pixel, so the outline moves by less than that.
    inside = is_arm.copy()
    for axis, shift in ((0, 1), (0, -1), (1, 1), (1, -1)):
        inside &= np.roll(is_arm, shift, axis)
    outline = is_arm & ~inside
    assert (is_arm != is_coarse_arm).sum() < 0.5 * outline.sum()
    both = is_arm & is_coarse_arm
    assert np.abs(fine - coarse)[both].mean() < 10


def test_coarse_files_are_small_and_written_once():
    urdf = find_urdf("franka_panda/panda.urdf")
    path = decimated_urdf(urdf, 0.013)
    assert decimated_urdf(urdf, 0.013) == path
    faces = [
        line
        for mesh in path.parent.glob("*.obj")
        for line in mesh.read_text().splitlines()
        if line.startswith("f ")
    ]
    assert 1000 < len(faces) < 12_000


def test_other_robots_load():
    camera = Camera(target=(0, 0, 0.5), width=32, height=32)
    with PhysicsClient() as physics:
        arm = physics.load_urdf("kuka_iiwa/model.urdf", fixed_base=True)
    with VisualClient(physics.blueprint, mesh_cell=0.02) as client:
        assert (client.draw(camera, segmentation=True).segmentation == arm).sum() > 50
