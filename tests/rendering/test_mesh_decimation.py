"""Coarse meshes: fewer triangles, the same picture."""

import numpy as np

from torch_panda.bullet import PhysicsClient
from torch_panda.bullet.urdf import find_urdf
from torch_panda.rendering import Camera
from torch_panda.rendering.mesh_decimation import decimated_urdf, merge_vertices
from torch_panda.rendering.visual_client import VisualClient


def make_ball(n=40):
    """Vertices, texture coordinates and corners of a sphere of radius 1."""
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, n), np.linspace(0, np.pi, n))
    vertices = np.stack(
        (np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)), axis=-1
    ).reshape(-1, 3)
    first = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate(
        [
            np.stack((first, first + n, first + 1), axis=1),
            np.stack((first + 1, first + n, first + n + 1), axis=1),
        ]
    )
    corners = np.stack((faces, np.zeros_like(faces)), axis=-1)
    return vertices, np.zeros((1, 2)), corners


def test_merged_vertices_stay_close_and_faces_keep_their_side():
    cell = 0.25
    vertices, coordinates, corners = make_ball()
    positions, texture, faces = merge_vertices(
        vertices, coordinates, corners, np.full(3, cell)
    )
    assert len(texture) == len(positions)
    assert len(faces) < len(corners)
    radius = np.linalg.norm(positions, axis=1)
    assert (np.abs(radius - 1) < cell * np.sqrt(3)).all()
    a, b, c = positions[faces[:, 0]], positions[faces[:, 1]], positions[faces[:, 2]]
    outward = (np.cross(b - a, c - a) * (a + b + c)).sum(axis=1)
    assert (outward > 0).mean() > 0.98
    # Nearly every triangle is unique, whichever vertex it starts with.
    assert len(np.unique(np.sort(faces, axis=1), axis=0)) >= 0.98 * len(faces)


def test_colors_stay_apart():
    vertices = np.array(
        [[0.1, 0.1, 0], [2.1, 0, 0], [0, 2.1, 0], [0.2, 0.2, 0], [-2, 0, 0]]
    )
    coordinates = np.array([[0.15, 0.15], [0.85, 0.85]])
    corners = np.array([[[0, 0], [1, 0], [2, 0]], [[3, 1], [2, 1], [4, 1]]])
    positions, texture, faces = merge_vertices(
        vertices, coordinates, corners, np.ones(3)
    )
    assert len(faces) == 2
    np.testing.assert_array_equal(texture[faces[0]], np.tile(coordinates[0], (3, 1)))
    np.testing.assert_array_equal(texture[faces[1]], np.tile(coordinates[1], (3, 1)))
    np.testing.assert_allclose(positions[faces[0, 0]], positions[faces[1, 0]])


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
