"""Coarse meshes: fewer triangles, the same picture."""

from pathlib import Path

import numpy as np
import pytest

from torch_panda.bullet import PhysicsClient
from torch_panda.bullet.urdf import find_urdf, parse_urdf
from torch_panda.rendering import Camera
from torch_panda.rendering.mesh_decimation import decimated_urdf
from torch_panda.rendering.renderer import mesh_cell
from torch_panda.rendering.visual_client import VisualClient


def test_the_arm_looks_the_same_from_afar():
    camera = Camera(target=(0, 0, 0.4), distance=1.4, width=64, height=64)
    images = []
    for cell in (0.0, 0.013):
        with PhysicsClient() as physics:
            arm = physics.load_urdf("franka_panda/panda.urdf", fixed_base=True)
            physics.set_joints(arm, (1, 3, 5), (0.41, -1.85, 2.26), (0.0,) * 3)
        with VisualClient(physics.blueprint, mesh_cell=cell) as client:
            image = client.render(camera, segmentation=True)
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


def test_a_mesh_cell_is_at_most_half_a_pixel():
    assert mesh_cell(Camera(distance=1.0, fov=90, width=50, height=100)) == 0.009
    assert mesh_cell(Camera()) == 0.0  # would not save time


def test_a_moving_camera_needs_few_mesh_cells():
    distances = np.linspace(0.1, 10, 500)
    cells = {mesh_cell(Camera(distance=d, width=64, height=64)) for d in distances}
    assert len(cells) < 10


def test_coarse_files_are_small_and_written_once():
    urdf = find_urdf("franka_panda/panda.urdf")
    path = decimated_urdf(urdf, 0.013)
    assert decimated_urdf(urdf, 0.013) == path
    faces = [
        line
        for mesh in parse_urdf(path).iter("mesh")
        for line in Path(mesh.get("filename")).read_text().splitlines()
        if line.startswith("f ")
    ]
    assert 1000 < len(faces) < 12_000


def test_another_robot_is_rendered_with_coarse_meshes():
    camera = Camera(target=(0, 0, 0.5), width=32, height=32)
    with PhysicsClient() as physics:
        arm = physics.load_urdf("kuka_iiwa/model.urdf", fixed_base=True)
    with VisualClient(physics.blueprint, mesh_cell=0.02) as client:
        assert (client.render(camera, segmentation=True).segmentation == arm).sum() > 50


TRIANGLE = """# Caf\u00e9
mtllib materials/paint.mtl
v 0 0 0
v {size} 0 0
v 0 {size} 0
vt 0 0
f 1/1 2/1 3/1
"""


@pytest.fixture
def two_parts(tmp_path):
    """A URDF whose two meshes and their textures have equal names."""
    links = ""
    for size, part in enumerate(("left", "right"), start=1):
        folder = tmp_path / part / "visual"
        (folder / "materials" / "images").mkdir(parents=True)
        mesh = TRIANGLE.format(size=size)
        (folder / "part.obj").write_bytes(mesh.encode("latin-1"))
        paint = "newmtl paint\nmap_Kd images/paint.png\n"
        (folder / "materials" / "paint.mtl").write_text(paint)
        (folder / "materials" / "images" / "paint.png").write_text(part)
        links += f"""<link name="{part}"><visual><geometry>
            <mesh filename="{part}/visual/part.obj"/></geometry></visual></link>"""
    path = tmp_path / "robot.urdf"
    path.write_text(f"<robot name='parts'>{links}</robot>")
    return path


def test_meshes_and_textures_of_equal_names_stay_apart(two_parts):
    robot = parse_urdf(decimated_urdf(str(two_parts), 0.01))
    found = []
    for mesh in robot.iter("mesh"):
        path = Path(mesh.get("filename"))
        lines = path.read_text().splitlines()
        size = max(float(line.split()[1]) for line in lines if line.startswith("v "))
        found.append((size, (path.parent / "paint.png").read_text()))
    assert found == [(1.0, "left"), (2.0, "right")]


@pytest.mark.parametrize(
    "mesh",
    [
        "v\t0 0 0\n  v 1 0 0\n\tv 0 1 0\nf\t1 2 3\n",
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0.5\n\nf 1/1 2/1 3/1\n",
        "v 0 0 0\n",
    ],
    ids=["tabs and indentation", "one texture coordinate", "no faces"],
)
def test_unusual_obj_files_are_read(tmp_path, mesh):
    (tmp_path / "part.obj").write_text(mesh)
    urdf = tmp_path / "robot.urdf"
    geometry = '<geometry><mesh filename="part.obj"/></geometry>'
    urdf.write_text(
        f"<robot name='r'><link name='l'><visual>{geometry}</visual></link></robot>"
    )
    (coarse,) = parse_urdf(decimated_urdf(str(urdf), 0.01)).iter("mesh")
    lines = Path(coarse.get("filename")).read_text().splitlines()
    assert sum(line.startswith("f ") for line in lines) == mesh.count("f")
