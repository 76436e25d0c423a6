"""Broken URDFs are refused with a reason, before Bullet reads them and crashes."""

import pytest

from torch_panda.bullet import BulletError, PhysicsClient
from torch_panda.bullet.urdf import check_urdf, find_urdf

BOX = "<geometry><box size='1 1 1'/></geometry>"


def link(name, content=""):
    return f"<link name='{name}'>{content}</link>"


def joint(name, parent, child, joint_type="fixed", content=""):
    ends = f"<parent link='{parent}'/><child link='{child}'/>"
    return f"<joint name='{name}' type='{joint_type}'>{ends}{content}</joint>"


def shape(geometry, tag="collision"):
    return f"<{tag}><geometry>{geometry}</geometry></{tag}>"


A, B, C = map(link, "abc")
BROKEN = {
    "an unattached link": (
        A + B + C + joint("j", "a", "b"),
        "no joint attaches link 'c' to the base 'a'",
    ),
    "two parents": (
        A + B + C + joint("j", "a", "b") + joint("k", "a", "c") + joint("l", "b", "c"),
        "link 'c' is the child of two joints, the second is 'l'",
    ),
    "a loop": (
        A + B + C + joint("j", "b", "c") + joint("k", "c", "b"),
        "joints form a loop through link 'b'",
    ),
    "no base": (A + joint("j", "a", "a"), "joints form a loop through link 'a'"),
    "no link": ("", "needs at least one <link>"),
    "a child that does not exist": (
        A + joint("j", "a", "b"),
        "joint 'j' must have a link of the file as its child, got 'b'",
    ),
    "a joint without a parent": (
        A + B + "<joint name='j' type='fixed'><child link='b'/></joint>",
        "joint 'j' must have a link of the file as its parent, got None",
    ),
    "equal joint names": (
        A + B + C + joint("j", "a", "b") + joint("j", "a", "c"),
        "two joints have the name 'j'",
    ),
    "equal link names": (A + A, "two links have the name 'a'"),
    "a link without a name": ("<link/>", "a <link> has no name"),
    "a joint without a type": (
        A + B + joint("j", "a", "b").replace("type='fixed'", ""),
        "joint 'j' must have one of the types .*, got None",
    ),
    "no limits": (
        A + B + joint("j", "a", "b", "revolute"),
        "joint 'j' is revolute and needs a <limit>",
    ),
    "no inertia": (
        link("a", "<inertial><mass value='1'/></inertial>"),
        "the <inertial> of link 'a' has no <inertia>",
    ),
    "a missing mesh": (
        link("a", shape("<mesh filename='no.obj'/>")),
        "a <collision> of link 'a' has the mesh 'no.obj', which does not exist",
    ),
    "a package that is elsewhere": (
        link("a", shape("<mesh filename='package://robot/no.stl'/>", "visual")),
        "a <visual> of link 'a' has the mesh 'package://robot/no.stl', which does not",
    ),
    "no geometry": (link("a", "<collision/>"), "link 'a' must have one of .* nothing"),
    "an unknown geometry": (
        link("a", shape("<cone/>")),
        "link 'a' must have one of .*'box'.* as its geometry, got <cone>",
    ),
    "a geometry without a size": (
        link("a", shape("<sphere/>")),
        "a <collision> of link 'a' has a <sphere> without 'radius'",
    ),
}


@pytest.fixture
def load(tmp_path):
    """Write a text into robot.urdf and load it."""
    with PhysicsClient() as client:

        def load(text):
            file = tmp_path / "robot.urdf"
            file.write_text(text)
            return client.load_urdf(file)

        yield load
        client.step()


@pytest.mark.parametrize("fault", BROKEN)
def test_a_broken_robot_is_refused_by_file_and_element(load, fault):
    content, message = BROKEN[fault]
    with pytest.raises(ValueError, match=rf"robot\.urdf: .*{message}"):
        load(f"<robot name='r'>{content}</robot>")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot", r"robot\.urdf is not XML: .*line 1"),
        ("<robot>\n<link>\n</robot>", r"robot\.urdf is not XML: .*line 3"),
        ("<model name='m'/>", r"robot\.urdf is not a URDF: it has no <robot>"),
        ("", r"robot\.urdf is not a URDF"),
    ],
)
def test_a_file_that_is_not_a_urdf_is_refused(load, text, message):
    with pytest.raises(ValueError, match=message):
        load(text)


@pytest.mark.parametrize("prefix", ["", "package://", "model://", "file://"])
def test_meshes_are_found_where_bullet_finds_them(tmp_path, prefix):
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
    (tmp_path / "meshes").mkdir()
    mesh = tmp_path / "meshes" / "corner.obj"
    mesh.write_text(corners + "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    (tmp_path / "urdf").mkdir()
    file = tmp_path / "urdf" / "robot.urdf"
    geometry = f"<mesh filename='{prefix}meshes/corner.obj'/>"
    file.write_text(f"<robot name='r'>{link('a', shape(geometry))}</robot>")
    with PhysicsClient() as client:
        assert client.load_urdf(file) == 0


@pytest.mark.parametrize(
    "name",
    [
        "humanoid/humanoid.urdf",  # ends with a null byte
        "differential/diff_ring.urdf",  # begins with an empty line
        "bicycle/bike.urdf",  # commas between numbers
        "husky/husky.urdf",
        "xarm/xarm6_with_gripper.urdf",
    ],
)
def test_files_that_bullet_reads_pass(name):
    check_urdf(find_urdf(name))


def test_bullet_prints_why_it_refuses_a_file(load):
    broken = "<axis xyz='0 1'/><limit lower='0' upper='1' effort='1' velocity='1'/>"
    hinge = joint("j", "a", "b", "revolute", broken)
    with pytest.raises(BulletError, match=r"load .*robot\.urdf \(it prints the reason"):
        load(f"<robot name='r'>{A}{B}{hinge}</robot>")
