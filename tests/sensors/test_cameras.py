"""Cameras as sensors."""

import pickle

import pytest
import torch
from torchrl.envs.utils import check_env_specs

import torch_panda
from torch_panda import Camera, CameraSensor, HandCamera
from torch_panda.bullet import Visual
from torch_panda.rendering import egl

# Most pictures below have the same size of a pixel, so that they share their coarse
# meshes.
SIZE = 48
IMAGES = {"from_pixels": True, "depth": True, "segmentation": True, "render_size": SIZE}


def make(env_id="PandaPush-v1", **arguments):
    return torch_panda.make(env_id, **{"num_envs": 3, "seed": 0, **IMAGES, **arguments})


@pytest.mark.parametrize("num_envs", [None, 3])
def test_images_have_the_shapes_and_types_of_their_specs(num_envs):
    with make("PandaStack-v1", num_envs=num_envs, sensors=("joint_torque",)) as env:
        check_env_specs(env)
        td = env.rollout(3)
        batch = () if num_envs is None else (num_envs,)
        for key, channels, dtype in (
            ("pixels", 3, torch.uint8),
            ("depth", 1, torch.float32),
            ("segmentation", 1, torch.int32),
        ):
            for value in (td[key], td["next", key]):
                assert value.shape == (*batch, 3, SIZE, SIZE, channels)
                assert value.dtype == dtype
        assert "observation" in td


def test_only_requested_images_are_observed():
    with make(depth=False, segmentation=False, pixels_only=True) as env:
        check_env_specs(env)
        keys = set(env.reset().keys()) - {"done", "terminated", "truncated", "success"}
        assert keys == {"pixels", "achieved_goal", "desired_goal"}
    with make(from_pixels=False, segmentation=False) as env:
        assert {"depth", "observation"} <= set(env.reset().keys())
        assert "pixels" not in env.reset()
    with pytest.raises(ValueError, match="pixels_only"):
        make(from_pixels=False, pixels_only=True)


def test_pixels_equal_the_pictures_of_render():
    camera = Camera(yaw=80)
    with make(num_envs=4, num_threads=2, camera=camera) as env:
        td = env.rollout(4)
        assert (
            env.render(camera=camera, size=SIZE) == td["next", "pixels"][:, -1]
        ).all()
        # Later steps do not overwrite earlier pictures.
        assert not (td["next", "pixels"][:, 0] == td["next", "pixels"][:, -1]).all()
        assert (td["next", "pixels"][:, :-1] == td["pixels"][:, 1:]).all()


def test_partial_resets_and_steps_leave_other_pictures_unchanged():
    with make() as env:
        td = env.reset()
        before = {key: td[key].clone() for key in ("pixels", "depth", "segmentation")}
        mask = torch.tensor([[False], [True], [False]])
        td = env.reset(td.clone().set("_reset", mask))
        for key, value in before.items():
            assert (td[key][[0, 2]] == value[[0, 2]]).all(), key
            assert not (td[key][1] == value[1]).all(), key
        before = {key: td[key].clone() for key in before}
        action = torch.ones(3, 3)
        td = env.step(td.set("action", action).set("_step", mask.squeeze(-1)))["next"]
        for key, value in before.items():
            assert (td[key][[0, 2]] == value[[0, 2]]).all(), key
            assert not (td[key][1] == value[1]).all(), key
    with make() as env:
        td = env.reset()
        state = env.get_state()
        env.rollout(5)
        again = env.reset(state, set_state=True)
        for key in before:
            assert (again[key] == td[key]).all(), key


def project(point, camera):
    """Column, row and depth of a point in a picture, from the camera's geometry."""
    yaw, pitch = torch.deg2rad(torch.tensor([camera.yaw, camera.pitch]).double())
    forward = torch.stack(
        (-yaw.sin() * pitch.cos(), yaw.cos() * pitch.cos(), pitch.sin())
    )
    right = torch.stack((yaw.cos(), yaw.sin(), torch.zeros_like(yaw)))
    up = torch.linalg.cross(right, forward)
    eye = torch.tensor(camera.target).double() - camera.distance * forward
    depth = (point - eye) @ forward
    focal = camera.height / 2 / torch.tan(torch.deg2rad(torch.tensor(camera.fov / 2)))
    column = camera.width / 2 + focal * ((point - eye) @ right) / depth
    row = camera.height / 2 - focal * ((point - eye) @ up) / depth
    return int(column), int(row), float(depth)


def test_segmentation_and_depth_show_objects_at_their_positions():
    camera = Camera(distance=0.7, yaw=120, pitch=-50, width=360, height=280)
    with make("PandaStack-v1", num_envs=2, camera=camera, render_size=None) as env:
        td = env.reset()
        ids = env.segmentation_ids
        assert set(ids) == {"nothing", "robot", "ground", "table", "object1", "object2"}
        assert set(td["segmentation"].unique().tolist()) <= set(ids.values())
        num_visible = 0
        for env_index in range(2):
            poses = env.get_state()["object_pose"][env_index]
            for name, position in zip(
                ("object1", "object2"), poses[:, :3], strict=True
            ):
                column, row, depth = project(position, camera)
                if td["segmentation"][env_index, row, column, 0] == ids[name]:
                    num_visible += 1
                    seen = td["depth"][env_index, row, column, 0]
                    # A face is 2 to 3.5 cm before the centre; a pixel is 3 mm wide.
                    assert 0.017 < depth - seen < 0.038
        assert num_visible >= 3  # the arm or a cube may hide one
        assert (td["depth"] <= camera.far).all()
        assert (td["depth"][td["segmentation"] == ids["nothing"]] == camera.far).all()


class Walls(torch_panda.Reach):
    """Reach with two walls of one name, and bodies without a name."""

    def build(self, client):
        bodies = super().build(client)
        for k, name in enumerate(("wall", "wall", None)):
            client.create_box(
                (0.02, 0.08, 0.1),
                mass=0.0,
                position=(0.2, 0.2 * k - 0.2, 0.1),
                visual=Visual(name=name),
            )
        client.load_urdf("cube_small.urdf", position=(0, 0.3, 0.05), fixed_base=True)
        return bodies


def test_each_body_of_a_segmentation_has_a_name():
    sensor = CameraSensor(Camera(width=SIZE, height=SIZE), segmentation=True)
    with torch_panda.RobotTaskEnv(
        robot=torch_panda.Panda(), task=Walls(), sensors=(sensor,)
    ) as env:
        seen = env.reset()["segmentation"].unique().tolist()
        ids = env.segmentation_ids
    assert set(seen) <= set(ids.values())
    unnamed = [name for name in ids if name.startswith("body")]
    named = {"nothing", "robot", "ground", "table", "wall1", "wall2"}
    assert set(ids) == {*named, *unnamed} and len(unnamed) == 2


def test_markers_are_in_pixels_but_not_in_depth_and_segmentation():
    camera = Camera(width=SIZE, height=SIZE)
    with make(num_envs=None, camera=camera, render_size=None) as env:
        td = env.reset()
        state = env.get_state()
        state["desired_goal"] = torch.tensor([-0.1, 0.1, 0.02]).double()
        other = env.reset(state, set_state=True)
        assert not (td["pixels"] == other["pixels"]).all()
        assert (td["depth"] == other["depth"]).all()
        assert (td["segmentation"] == other["segmentation"]).all()


def test_a_pickled_environment_keeps_its_cameras():
    with (
        make(sensors=("joint_torque",)) as env,
        pickle.loads(pickle.dumps(env)) as copy,
    ):
        assert copy.observation_spec == env.observation_spec
        assert (copy.reset()["pixels"] == env.reset()["pixels"]).all()


def test_egl_agrees_with_tiny_renderer_or_raises():
    camera = Camera(pitch=-90, width=SIZE, height=SIZE)
    options = {"num_envs": 2, "camera": camera, "render_size": None}
    try:
        env = make(renderer="egl", **options)
    except RuntimeError as error:
        assert "does not work on this machine" in str(error)
        return
    with env, make(**options) as tiny:
        ours, theirs = env.reset(), tiny.reset()
        ids = env.segmentation_ids
        # Lights and edges differ, but the same bodies are at the same places.
        same = ours["segmentation"] == theirs["segmentation"]
        assert same.float().mean() > 0.95
        for images in (ours, theirs):
            table = images["depth"][images["segmentation"] == ids["table"]]
            assert table.median() == pytest.approx(1.4, abs=1e-4)
        assert ours["pixels"].float().std() > 20
        # A picture does not depend on earlier pictures.
        again = env.reset(env.get_state(), set_state=True)
        assert (again["pixels"] == ours["pixels"]).all()


def test_egl_that_does_not_work_raises(monkeypatch):
    egl._check_egl.cache_clear()
    monkeypatch.setattr(egl, "_EGL_PROBE", "raise SystemExit('no EGL device')")
    with pytest.raises(RuntimeError, match=r"use 'tiny'.*no EGL device"):
        make(renderer="egl")
    egl._check_egl.cache_clear()


def test_a_camera_on_the_hand_sees_the_cube_beside_a_fixed_camera():
    front = CameraSensor(Camera(width=48, height=48, shadows=False))
    hand = CameraSensor(
        HandCamera(width=64, height=48, shadows=False),
        depth=True,
        segmentation=True,
        name="wrist",
    )
    with torch_panda.make(
        "PandaPickAndPlace-v1", num_envs=2, seed=0, sensors=(front, hand)
    ) as env:
        check_env_specs(env)
        td = env.reset()
        assert td["pixels"].shape == (2, 48, 48, 3)
        assert td["wrist_pixels"].shape == (2, 48, 64, 3)
        assert td["wrist_depth"].shape == (2, 48, 64, 1)
        picture = env.render(camera=hand.camera)
        assert (picture == td["wrist_pixels"]).all()
        # The open hand is above the cube, which is in the middle of the picture.
        ids = env.segmentation_ids
        for _ in range(20):
            above = td["achieved_goal"] + torch.tensor((0.0, 0.0, 0.1))
            error = above - td["observation"][:, :3]
            action = torch.cat((10 * error, torch.ones(2, 1)), dim=1)
            td = env.step(td.set("action", action))["next"]
        seen = td["wrist_segmentation"][..., 0]
        rows, columns = (seen[0] == ids["object"]).nonzero().double().T
        assert len(rows) > 20 and abs(columns.mean() - 31.5) < 6
        assert (seen == ids["robot"]).any()  # the fingers
        near = td["wrist_depth"][0, ..., 0][seen[0] == ids["object"]]
        assert 0.1 < near.min() < near.max() < 0.35
        before = td["wrist_pixels"].clone()
        action = torch.tensor([[0.0, 0.0, 1.0, 0.0]]).expand(2, -1)
        td = env.step(td.set("action", action))["next"]
        assert (td["wrist_pixels"] != before).any()


def test_a_camera_on_the_hand_turns_with_it():
    """The fingers stay at the left and the right of its picture."""
    camera = HandCamera(width=64, height=48, shadows=False)
    with make(
        "PandaReachJoints-v1", num_envs=None, camera=camera, render_size=None
    ) as env:
        seen = []
        env.reset()
        state = env.get_state()
        for angle in (0.0, 1.2):
            state["joint_position"][6] = angle
            seen.append(env.reset(state, set_state=True)["segmentation"])
        robot = [picture == env.segmentation_ids["robot"] for picture in seen]
    assert 200 < robot[0].sum() < 2500
    for other in (robot[1], robot[0].flip(1)):
        assert (robot[0] != other).float().mean() < 0.02


def test_two_cameras_without_names_are_refused():
    with pytest.raises(ValueError, match="are observed twice"):
        torch_panda.make("PandaPush-v1", sensors=(CameraSensor(), CameraSensor()))
    with pytest.raises(ValueError, match="line of sight"):
        HandCamera(up=(0.0, 0.0, 1.0), eye=(0.0, 0.0, -0.1), target=(0.0, 0.0, 0.1))
