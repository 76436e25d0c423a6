"""Pictures of environments: `RobotTaskEnv.render`, also as torchrl observes them."""

from contextlib import closing

import numpy as np
import pybullet
import pytest
import torch
from tensordict import TensorDict
from torchrl.record import PixelRenderTransform

import torch_panda
from tests.panda_gym_reference import make_reference, start
from torch_panda import BulletError, Camera
from torch_panda.bullet import Sphere
from torch_panda.tasks import Bodies

TASKS = ("Reach", "Push", "Slide", "PickAndPlace", "Stack", "Flip")
# panda-gym's view in half its size; above 200 pixels, meshes have all their details.
WIDTH, HEIGHT = 360, 240
# Small pictures below have the same size of a pixel, so that they share their coarse
# meshes.
CLOSE = Camera(target=(0.0, 0.0, 0.0), distance=0.5, width=60, height=40)


def render_reference(reference):
    """panda-gym's picture, and a mask of the pixels that show a target."""
    client = reference.sim.physics_client
    view = client.computeViewMatrixFromYawPitchRoll((0, 0, 0), 1.4, 45, -30, 0, 2)
    projection = client.computeProjectionMatrixFOV(60, WIDTH / HEIGHT, 0.1, 100)
    ids = client.getCameraImage(
        WIDTH, HEIGHT, view, projection, renderer=pybullet.ER_TINY_RENDERER
    )[4]
    bodies = reference.sim._bodies_idx
    targets = [body for name, body in bodies.items() if name.startswith("target")]
    return reference.render(), np.isin(np.reshape(ids, (HEIGHT, WIDTH)), targets)


@pytest.mark.parametrize("task", TASKS)
def test_pictures_equal_those_of_panda_gym(task):
    """Only targets differ, because panda-gym draws them opaque."""
    reference = make_reference(
        f"Panda{task}-v3", render_width=WIDTH, render_height=HEIGHT
    )
    _, poses, goal = start(reference, seed=3)
    theirs, is_target = render_reference(reference)
    reference.close()
    with torch_panda.make(f"Panda{task}-v3", seed=0) as env:
        state = TensorDict({"desired_goal": torch.as_tensor(goal).double()})
        if len(poses):
            state["object_pose"] = torch.as_tensor(poses)
        env.reset(state, set_state=True)
        ours = env.render(size=(HEIGHT, WIDTH)).numpy()
    assert ours.shape == (HEIGHT, WIDTH, 3)
    difference = np.abs(ours.astype(int) - theirs.astype(int))
    differs = difference.max(axis=-1) > 0
    if task == "Flip":  # panda-gym's wheel lacks the texture and draws no cube
        assert 0 < differs[~is_target].sum() < 600 * (HEIGHT / 480) ** 2
    else:
        assert not differs[~is_target].any()
        assert is_target.sum() > 12
        # Translucent targets differ from panda-gym's opaque ones.
        assert differs[is_target].mean() > 0.9


def test_targets_are_translucent():
    with torch_panda.make("PandaPush-v1", seed=0) as env:
        env.reset()
        camera = Camera(
            target=tuple(env.get_state()["desired_goal"].tolist()),
            distance=0.2,
            pitch=-90,
            width=16,
            height=16,
        )
        seen = env.render(camera=camera)[8, 8].float()
        state = env.get_state()
        state["desired_goal"] = torch.tensor([0.0, 3.0, 0.02], dtype=torch.float64)
        env.reset(state, set_state=True)
        behind = env.render(camera=camera)[8, 8].float()
    # 30 % green over the grey table.
    assert behind[0] == behind[1] == behind[2]
    assert seen[0] < behind[0] and seen[0] == seen[2] < seen[1]
    assert seen[0] > 0.7 * behind[0]


def test_a_marker_below_the_table_is_hidden():
    camera = Camera(distance=0.5, pitch=-90, width=40, height=40)
    pictures = []
    with torch_panda.make("PandaPush-v1", seed=0) as env:
        env.reset()
        state = env.get_state()
        for place in ((0.1, 0.1, -0.05), (0.0, 3.0, 0.02)):
            state["desired_goal"] = torch.tensor(place, dtype=torch.float64)
            env.reset(state, set_state=True)
            pictures.append(env.render(camera=camera))
    assert (pictures[0] == pictures[1]).all()


def test_an_open_drawer_is_rendered_open():
    pictures, camera = [], Camera(distance=0.5, pitch=-60, width=60, height=40)
    with torch_panda.make("PandaDrawer-v1", seed=0) as env:
        env.reset()
        state = env.get_state()
        for opening in (0.0, 0.08):
            state["object_joint_position"].fill_(opening)
            env.reset(state, set_state=True)
            pictures.append(env.render(camera=camera))
    assert (pictures[0] != pictures[1]).any(-1).sum() > 30


class HiddenURDF(torch_panda.Task):
    """The goal is in the air, at the place where the cube's URDF is loaded."""

    goal_dim, observation_dim = 3, 0
    place = (0.0, 0.25, 0.2)

    def __init__(self, *, marker_first):
        super().__init__()
        self.marker_first = marker_first

    def build(self, client):
        if self.marker_first:
            marker = client.create_marker(self.place, Sphere(0.015))
        cube = client.load_urdf("cube_small.urdf", position=self.place)
        if not self.marker_first:
            marker = client.create_marker(self.place, Sphere(0.015))
        return Bodies(objects=(cube,), markers=(marker,))

    def sample_goal(self, rng):
        return self.place

    def sample_objects(self, rng):
        return ((-0.2, -0.3, 0.03, 0, 0, 0, 1),)

    def achieved_goal(self, simulation):
        return simulation.object_pose[:, 0, :3]


@pytest.mark.parametrize("marker_first", [True, False])
def test_a_marker_is_visible_where_a_urdf_was_loaded(marker_first):
    task = HiddenURDF(marker_first=marker_first)
    with torch_panda.RobotTaskEnv(robot=torch_panda.Panda(), task=task) as env:
        env.reset()
        camera = Camera(target=task.place, distance=0.2, width=40, height=40)
        seen = env.render(camera=camera)
        env.episodes.simulation.marker_pose[..., 2] = -50.0
        changed = (seen != env.render(camera=camera)).any(dim=-1)
    assert changed.sum() > 20


class Housing(torch_panda.Sensor):
    """A sensor that adds a box to the scene and observes nothing."""

    entries = {}  # noqa: RUF012 (as its own reading)

    def build(self, client, body, robot):
        client.create_box((0.05,) * 3, mass=0.0, position=(0.0, 0.0, 0.0))

    def attach(self, simulation, renderer, robot):
        return self

    def after_reset(self, envs):
        pass

    after_step = after_reset


def test_bodies_of_a_sensor_are_rendered():
    pictures = []
    for sensors in ((), (Housing(),)):
        with torch_panda.make("PandaReach-v1", seed=0, sensors=sensors) as env:
            env.reset()
            pictures.append(env.render(camera=CLOSE))
    assert (pictures[0] != pictures[1]).any()


def test_shadows_only_darken():
    bright = Camera(width=180, height=120, shadows=False)
    with torch_panda.make("PandaPush-v1", seed=0) as env:
        env.reset()
        without = env.render(camera=bright).int()
        shaded = env.render(size=(120, 180)).int()
    assert (shaded <= without).all()
    darker = without - shaded  # up to 2 everywhere, 17 in shadows
    assert 0.001 < (darker > 5).float().mean() < 0.1


def test_render_shows_the_chosen_environments():
    with torch_panda.make("PandaPush-v1", num_envs=5, num_threads=2, seed=0) as env:
        with pytest.raises(ValueError, match="environment 0 was not reset: call reset"):
            env.render()
        env.reset()
        every = env.render(camera=CLOSE)
        assert every.shape == (5, 40, 60, 3) and every.dtype == torch.uint8
        assert len(every.flatten(1).unique(dim=0)) == 5
        state = env.get_state()
        with torch_panda.make("PandaPush-v1") as single:
            for index in (0, 4):
                single.reset(state[index], set_state=True)
                assert (single.render(camera=CLOSE) == every[index]).all()
        assert (env.render([3, 1], camera=CLOSE) == every[[3, 1]]).all()
        assert (env.render(4, camera=CLOSE) == every[4]).all()
        assert env.render(4, camera=CLOSE, size=(42, 50)).shape == (42, 50, 3)
        for wrong in (5, -1, [0, 7]):
            with pytest.raises(
                ValueError, match="an index of an environment must be from 0 to 4"
            ):
                env.render(wrong, camera=CLOSE)
    with pytest.raises(BulletError, match="closed"):
        env.render()


def test_rendering_does_not_change_the_simulation():
    rollouts = []
    for look in (False, True):
        with torch_panda.make("PandaPickAndPlace-v1", num_envs=2, seed=0) as env:
            torch.manual_seed(0)
            callback = (lambda env, td: env.render(camera=CLOSE)) if look else None
            rollouts.append(env.rollout(15, callback=callback))
    assert (rollouts[0] == rollouts[1]).all()


@pytest.mark.parametrize("num_envs", [None, 4])
def test_torchrl_observes_pictures_of_render(num_envs):
    env = torch_panda.make("PandaPush-v1", num_envs=num_envs, seed=0)
    transform = PixelRenderTransform(camera=CLOSE, size=(42, 50))
    with closing(env.append_transform(transform)) as recorded:
        rollout = recorded.rollout(3)
        batch = () if num_envs is None else (num_envs,)
        assert rollout["next", "pixels"].shape == (*batch, 3, 42, 50, 3)
        picture = env.render(camera=CLOSE, size=(42, 50))
        assert (rollout["next", "pixels"][..., -1, :, :, :] == picture).all()
