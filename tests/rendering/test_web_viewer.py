"""The viewer in the browser shows environments, and serves its own page only."""

import socket
from concurrent.futures import ThreadPoolExecutor
from http.client import HTTPConnection
from itertools import combinations, product
from unittest.mock import Mock

import numpy as np
import pybullet
import pytest
import torch

import torch_panda

pytest.importorskip("yourdfpy", reason="needs the extra viewer")

from viser.transforms import SO3
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from torch_panda.bullet import Box, PhysicsClient
from torch_panda.rendering import Camera, web_bodies, web_viewer
from torch_panda.rendering.visual_client import VisualClient
from torch_panda.tasks import Bodies
from torch_panda.tasks.flip import VISUAL


@pytest.fixture
def env():
    with torch_panda.make("PandaPush-v1", num_envs=2, seed=0) as env:
        yield env


def world_pose(nodes, name):
    """Transform of a node of the scene tree to the world frame (4, 4)."""
    pose = np.eye(4)
    while name:
        node = nodes[name]
        local = np.eye(4)
        local[:3, :3] = SO3(np.asarray(node.wxyz)).as_matrix()
        local[:3, 3] = node.position
        pose, name = local @ pose, name.rpartition("/")[0]
    return pose


def nodes_of(viewer):
    return viewer._server.scene._handle_from_node_name


class Click:
    """The event of a control that a person moved."""

    client = "a browser"


def test_the_page_shows_the_state(env):
    env.reset()
    bent = env.get_state()
    bent["joint_position"] += torch.linspace(0.1, 0.4, 9) * 0.5
    with env.open_viewer(port=8765) as viewer:
        env.reset(bent, set_state=True)
        viewer.update()
        nodes, simulation = nodes_of(viewer), env.episodes.simulation
        scene = simulation.scene
        # The end-effector is a link without a shape, between the fingers.
        ee = next(name for name in nodes if name.endswith("/panda_grasptarget"))
        np.testing.assert_allclose(
            world_pose(nodes, ee)[:3, 3], simulation.ee_position[0], atol=1e-6
        )
        # The URDF couples the fingers, but Bullet and the page do not.
        for finger, shift in (("left", 1), ("right", -1)):
            node = next(
                x for name, x in nodes.items() if name.endswith(f"_{finger}finger")
            )
            joint = simulation.joint_position[0, 7 if finger == "left" else 8]
            assert node.position[1] == pytest.approx(shift * joint.item())
        for bodies, poses in (
            (scene.objects, simulation.object_pose),
            (scene.markers, simulation.marker_pose),
        ):
            for body, pose in zip(bodies, poses[0], strict=True):
                node = nodes[f"/body{body}"]
                np.testing.assert_array_equal(node.position, pose[:3])
                np.testing.assert_array_equal(node.wxyz[[1, 2, 3, 0]], pose[3:])
        env.step(env.full_action_spec.rand())
        viewer.update()
        assert "step 1" in viewer._status.content


def test_the_page_pauses_goes_back_and_goes_on(env):
    env.reset()
    with env.open_viewer(port=8765) as viewer:
        viewer.update()
        shown = []
        for step in range(1, 4):
            env.step(env.full_action_spec.rand())
            viewer.update()
            shown.append(env.get_state()["object_pose"][:, 0, :3].clone())
            assert viewer._step.value == step
        assert viewer._step.max == 3
        viewer._chosen.value = 1
        viewer._step.value = 2
        viewer._go_to(Click)
        assert viewer.paused
        assert "environment 1" in viewer._status.content
        assert "step 2" in viewer._status.content
        objects = env.episodes.simulation.scene.objects
        cube = nodes_of(viewer)[f"/body{objects[0]}"]
        # viser does not send movements of a few micrometres.
        np.testing.assert_allclose(cube.position, shown[1][1], atol=1e-5)
        env.step(env.full_action_spec.rand())
        viewer.update()  # records the state, but does not show it
        assert viewer._step.value == 2
        viewer._pause.value = False
        assert not viewer.paused
        env.step(env.full_action_spec.rand())
        viewer.update()
        assert viewer._step.value == 5
        env.reset()
        viewer.update()
        assert viewer._step.value == 0
        assert "step 0" in viewer._status.content


def test_the_page_begins_with_the_view_of_the_camera(env):
    env.reset()
    camera = Camera(target=(0.1, 0.2, 0.3), distance=0.9, yaw=20, pitch=-40)
    with env.open_viewer(port=8765, camera=camera) as viewer:
        view = viewer._server.initial_camera
        matrix = pybullet.computeViewMatrixFromYawPitchRoll(
            camera.target, camera.distance, camera.yaw, camera.pitch, 0, 2
        )
        world_to_camera = np.reshape(matrix, (4, 4)).T
        eye = world_to_camera @ (*view.position, 1)
        target = world_to_camera @ (*view.look_at, 1)
    np.testing.assert_allclose(eye[:3], 0, atol=1e-6)
    np.testing.assert_allclose(target[:3], (0, 0, -camera.distance), atol=1e-6)


# Yaw and pitch of the view of each face of a box, by axis and side.
VIEWS = {
    (0, 1): (90, 0), (0, -1): (-90, 0), (1, 1): (180, 0), (1, -1): (0, 0),
    (2, 1): (0, -90), (2, -1): (0, 90),
}  # fmt: skip


def test_a_textured_box_has_the_colours_of_a_picture():
    box = Box((0.02,) * 3)
    with PhysicsClient() as physics:
        physics.create_box(box.half_extents, mass=0, position=(0,) * 3, visual=VISUAL)
    mesh = web_bodies.textured_box(box, VISUAL.texture)
    colors = mesh.visual.to_color().vertex_colors[:, :3].astype(float)
    seen = {}
    with VisualClient(physics.blueprint) as client:
        for face, normal in enumerate(mesh.face_normals):
            axis = int(abs(normal).argmax())
            yaw, pitch = VIEWS[axis, round(normal[axis])]
            camera = Camera(
                distance=0.2, yaw=yaw, pitch=pitch, fov=11, width=9, height=9
            )
            drawn = client.render(camera, shadow=False).rgb.astype(float)
            shown = colors[mesh.faces[face, 0]]
            # Compare hues, because shading changes the brightness.
            whole = drawn.mean((0, 1))
            hues = [x / np.linalg.norm(x) for x in (drawn[4, 4], shown, whole)]
            np.testing.assert_allclose(*hues[:2], atol=0.1)
            seen[yaw, pitch] = hues[2]
    assert len(seen) == 6
    for a, b in combinations(seen.values(), 2):
        assert np.linalg.norm(a - b) > 0.15


def test_the_contact_forces_carry_the_weight_of_the_cube():
    with torch_panda.make("PandaPush-v3", seed=1) as env:
        env.reset()
        for _ in range(5):
            env.step(env.full_action_spec.zero())
        simulation = env.episodes.simulation
        forces = web_viewer.read_forces(simulation.clients[0], simulation)
        near = abs(forces[:, 0, 2]) < 0.01  # contacts with the table
        assert forces[near, 1].sum(0) == pytest.approx((0, 0, 9.81), abs=0.2)
    long = web_viewer.arrows(
        np.array([[[0, 0, 0], [0, 0, 10]], [[0, 0, 0], [99, 0, 0]]])
    )
    np.testing.assert_allclose(long[:, 1], [[0, 0, 0.05], [0.12, 0, 0]])


@pytest.mark.parametrize("task", ["Slide", "Flip"])
def test_the_page_has_the_objects_and_markers_of_a_task(task):
    with torch_panda.make(f"Panda{task}-v1", seed=0) as env:
        env.reset()
        with env.open_viewer(port=8765) as viewer:
            viewer.update()
            nodes, scene = nodes_of(viewer), env.episodes.simulation.scene
            for body in (*scene.objects, *scene.markers):
                assert f"/body{body}" in nodes
        viewer.close()


class Neighbours(torch_panda.Task):
    """Two arms beside the robot; building bent the second one."""

    goal_dim, observation_dim = 3, 0

    def build(self, client):
        self.arms = [
            client.load_urdf("kuka_iiwa/model.urdf", position=(0, y, 0.1))
            for y in (-0.5, 0.5)
        ]
        client.set_joints(self.arms[1], (1, 3), (0.4, -0.7), (0.0, 0.0))
        return Bodies()

    def sample_goal(self, rng):
        return (0.0, 0.0, 0.0)

    def achieved_goal(self, simulation):
        return simulation.ee_position


def test_bodies_that_nothing_moves_are_shown_as_they_were_built():
    task = Neighbours()
    with torch_panda.RobotTaskEnv(robot=torch_panda.Panda(), task=task) as env:
        client = env.episodes.simulation.clients[0]
        centres = [client.state(arm).link_pose(6)[:3].copy() for arm in task.arms]
        with env.open_viewer(port=8765) as viewer:
            nodes = nodes_of(viewer)
            for arm, centre in zip(task.arms, centres, strict=True):
                tip = next(
                    name
                    for name in nodes
                    if name.startswith(f"/body{arm}/") and name.endswith("_link_7")
                )
                shown = world_pose(nodes, tip) @ (*client.inertial_frame(arm, 6)[:3], 1)
                np.testing.assert_allclose(shown[:3], centre, atol=1e-6)


class Plate(torch_panda.Task):
    """An object from a URDF whose inertial frame is neither at its base nor upright."""

    goal_dim, observation_dim = 3, 0

    def __init__(self, urdf):
        self.urdf = urdf

    def build(self, client):
        return Bodies(objects=(client.load_urdf(self.urdf),))

    def sample_objects(self, rng):
        return ((0.2, 0.1, 0.5, 0.0, 0.8, 0.0, 0.6),)

    def sample_goal(self, rng):
        return (0.0, 0.0, 0.0)

    def achieved_goal(self, simulation):
        return simulation.object_pose[:, 0, :3]


def test_an_object_with_a_shifted_centre_of_mass_is_where_bullet_has_it(tmp_path):
    path = tmp_path / "plate.urdf"
    box = '<geometry><box size="0.1 0.2 0.04"/></geometry><origin xyz="0.02 0 0"/>'
    path.write_text(
        f"""<robot name="plate"><link name="plate"><inertial><mass value="1"/>
        <origin xyz="0.05 0 0.1" rpy="0 0.5 0"/>
        <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
        <visual>{box}</visual><collision>{box}</collision></link></robot>"""
    )
    with torch_panda.RobotTaskEnv(robot=torch_panda.Panda(), task=Plate(path)) as env:
        env.reset()
        (body,) = env.episodes.simulation.scene.objects
        x, y, z, *quaternion = env.get_state()["object_pose"].flatten().tolist()
        rotation = SO3.from_quaternion_xyzw(np.array(quaternion))
        inertial = SO3.from_y_radians(0.5)
        with env.open_viewer(port=8765) as viewer:
            viewer.update()
            shown = world_pose(nodes_of(viewer), f"/body{body}/base")
        np.testing.assert_allclose(shown @ (0.05, 0, 0.1, 1), (x, y, z, 1), atol=1e-6)
        upright = (rotation @ inertial.inverse()).as_matrix()
        np.testing.assert_allclose(shown[:3, :3], upright, atol=1e-6)


def test_parts_of_a_urdf_that_the_page_cannot_show_are_left_out(tmp_path):
    capsule = '<geometry><capsule radius="0.1" length="0.2"/></geometry>'
    red = '<material name="red"><color rgba="1 0 0"/></material>'
    ball = f'<geometry><sphere radius="0.1"/></geometry>{red}'
    path = tmp_path / "limb.urdf"
    path.write_text(
        f"""<robot name="limb">
        <link name="upper"><visual>{capsule}</visual><visual>{ball}</visual>
        <collision>{capsule}</collision></link>
        <link name="lower"><visual>{ball}</visual></link><link name="hand"/>
        <joint name="elbow" type="spherical">
        <parent link="upper"/><child link="lower"/></joint>
        <joint name="wrist" type="continuous">
        <parent link="lower"/><child link="hand"/></joint></robot>"""
    )
    urdf = web_bodies._read_urdf(str(path))
    assert len(urdf.scene.geometry) == 2
    assert urdf.actuated_joint_names == ["wrist"]


def test_an_open_drawer_is_open_on_the_page():
    with torch_panda.make("PandaDrawer-v1", seed=0) as env:
        env.reset()
        state = env.get_state()
        state["object_joint_position"].fill_(0.08)
        env.reset(state, set_state=True)
        with env.open_viewer(port=8765) as viewer:
            viewer.update()
            nodes = nodes_of(viewer)
            drawer = next(x for name, x in nodes.items() if name.endswith("/drawer"))
            assert np.abs(drawer.position).max() == pytest.approx(0.08)


def test_wrong_calls_of_a_viewer_raise_clear_errors(env, monkeypatch):
    with env.open_viewer(port=8765) as viewer:
        with pytest.raises(torch_panda.BulletError, match="never reset"):
            viewer.update()
        env.reset()
        with (
            ThreadPoolExecutor(1) as thread,
            env.episodes.exclusive(),
            pytest.raises(torch_panda.BulletError, match="another thread"),
        ):
            thread.submit(viewer.update).result()
        assert viewer.url.startswith("http://127.0.0.1:87")
        monkeypatch.setattr(viewer._server, "get_host", lambda: "::1")
        assert viewer.url.startswith("http://[::1]:87")
    with pytest.raises(TypeError, match="camera must be an instance of Camera"):
        env.open_viewer("front")
    env.close()
    with pytest.raises(torch_panda.BulletError, match="closed"):
        env.open_viewer()


@pytest.fixture(scope="module")
def viewer():
    with torch_panda.make("PandaReach-v1", seed=0) as env:
        env.reset()
        with env.open_viewer(port=8765, allowed_hosts=("lab.example",)) as viewer:
            viewer.update()
            yield viewer


def get(viewer, host):
    """Status and text of the answer to a request with this header Host."""
    connection = HTTPConnection("127.0.0.1", viewer._server.get_port(), timeout=10)
    connection.putrequest("GET", "/", skip_host=True)
    for name in host if isinstance(host, tuple) else (host,):
        connection.putheader("Host", name)
    connection.endheaders()
    response = connection.getresponse()
    return response.status, response.read().decode()


@pytest.mark.parametrize(
    "host",
    ["localhost", "127.0.0.1:8765", "[::1]:9", "LocalHost:80", "lab.example:8443"],
)
def test_the_page_is_served_under_loopback_and_listed_names(viewer, host):
    status, text = get(viewer, host)
    assert status == 200
    assert "<html" in text


@pytest.mark.parametrize(
    "host",
    [
        "evil.example",
        "evil.example:8765",
        "localhost.evil.example",
        "evil.example@localhost",
        "localhost:x",
        "",
        ("localhost", "evil.example"),
    ],
)
def test_the_page_is_not_served_under_other_names(viewer, host):
    status, _ = get(viewer, host)
    assert status in (400, 403)


def test_a_refusal_says_how_to_allow_a_name(viewer):
    status, text = get(viewer, "robot.example:80")
    assert status == 403
    assert "'robot.example'" in text and "allowed_hosts" in text


def open_socket(viewer, origin, host="localhost:8765"):
    """Open a web socket as viser's page does, with these headers."""
    return connect(
        f"ws://{host}",
        sock=socket.create_connection(("127.0.0.1", viewer._server.get_port())),
        origin=origin,
        subprotocols=[f"viser-v{web_bodies.viser.__version__}"],
        open_timeout=10,
        max_size=None,
    )


@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.example",
        "http://evil.example:8765",
        "http://localhost:8766",  # another server on the same machine
        "http://localhost",
        "null",
    ],
)
def test_other_web_pages_cannot_connect(viewer, origin):
    with pytest.raises(InvalidStatus, match="403"):
        open_socket(viewer, origin)


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("localhost:8765", "http://localhost:8765"),
        ("localhost:9000", "http://localhost:9000"),  # a tunnel's port
        ("lab.example", "https://lab.example"),  # a tunnel with TLS
        ("127.0.0.1:8765", None),  # no browser
    ],
)
def test_the_own_page_can_connect(viewer, host, origin):
    with open_socket(viewer, origin, host) as connection:
        assert connection.recv(timeout=10)


def test_a_version_of_viser_that_cannot_be_checked_is_refused(env, monkeypatch):
    unchecked = Mock()
    monkeypatch.setattr(web_viewer.viser, "ViserServer", unchecked)
    with pytest.raises(RuntimeError, match="cannot check web requests"):
        env.open_viewer(port=8765)
    unchecked.return_value.stop.assert_called_once()


def test_a_viewer_that_cannot_show_the_bodies_stops_its_server(env, monkeypatch):
    stop = Mock(wraps=web_viewer.viser.ViserServer.stop)
    monkeypatch.setattr(web_viewer.viser.ViserServer, "stop", lambda self: stop(self))
    monkeypatch.setattr(web_viewer, "WebBodies", Mock(side_effect=OSError))
    with pytest.raises(OSError):
        env.open_viewer(port=8765)
    stop.assert_called_once()


def test_indices_from_a_browser_never_raise(env):
    """A client may send indices beyond the limits of the page's sliders."""
    env.reset()
    with env.open_viewer(port=8765) as viewer:
        viewer.update()
        for chosen, step in product((-100, -1, 2, 10**30), (-100, 99, 10**30)):
            for handle, value in ((viewer._chosen, chosen), (viewer._step, step)):
                handle._impl.value = value
            viewer._choose(Click)
            viewer._go_to(Click)
            assert viewer.paused
            viewer._pause.value = False
            env.step(env.full_action_spec.rand())
            viewer.update()
        assert "step 12" in viewer._status.content
