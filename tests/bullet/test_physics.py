"""Physics parameters: their effect, and the values that are refused."""

import dataclasses

import numpy as np
import pytest
import torch

import torch_panda
from tests.pushing import pusher
from torch_panda import PhysicsParams
from torch_panda.bullet import EXACT, FAST, PhysicsClient


def rollout(physics, env_id="PandaPush-v1"):
    """Observations while the arm moves to the cube and pushes it, (20, 18)."""
    with torch_panda.make(env_id, seed=1, physics=physics) as env:
        return env.rollout(20, pusher(env))["next", "observation"]


@pytest.fixture(scope="module")
def exact():
    return rollout("exact")


def test_exact_physics_are_the_default_and_fast_physics_a_preset(exact):
    assert PhysicsParams() == EXACT
    assert PhysicsParams(1 / 500, 20, 50, 1e-7, 0.1, -9.81) == EXACT
    with torch_panda.make("PandaReach-v1") as env:
        assert env.physics == EXACT
    with torch_panda.make("PandaReach-v1", physics="fast") as env:
        assert env.physics == FAST
    explicit = rollout(PhysicsParams(timestep=0.002, n_substeps=20))
    assert torch.equal(exact, explicit)


def test_fast_physics_move_the_arm_like_exact_physics():
    assert pytest.approx(EXACT.ctrl_dt) == FAST.ctrl_dt
    exact, fast = rollout("exact", "PandaReach-v1"), rollout("fast", "PandaReach-v1")
    assert not torch.equal(exact, fast)
    distance = (exact - fast)[..., :3].norm(dim=-1)
    assert distance.max() < 5e-3  # [m]


def fall(physics):
    """Height by which a body falls in 0.2 s [m]."""
    with PhysicsClient(physics=physics) as client:
        body = client.create_sphere(0.1, mass=1.0, position=(0.0, 0.0, 0.0))
        client.step(round(0.2 / physics.timestep))
        return -client.state(body).base_pose[2]


def test_timestep_and_gravity_reach_bullet():
    # Semi-implicit Euler gives g (t^2 + t dt) / 2, without Bullet's damping.
    for physics in (PhysicsParams(), PhysicsParams(timestep=0.01, gravity=-2.0)):
        t, dt = 0.2, physics.timestep
        expected = -physics.gravity * (t * t + t * dt) / 2
        assert fall(physics) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize(
    "change",
    [
        {"solver_iterations": 1},
        {"residual_threshold": 1.0},
        {"position_gain": 0.2},
        {"ik_iterations": 5},
        {"ik_damping": 0.1},
    ],
)
def test_every_parameter_reaches_bullet(change, exact):
    assert not torch.equal(exact, rollout(PhysicsParams(**change)))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"timestep": 0.0}, "timestep must be positive"),
        ({"n_substeps": 0}, "n_substeps must be at least 1, got 0"),
        (
            {"residual_threshold": -1.0},
            "residual_threshold must be finite and at least 0",
        ),
        ({"position_gain": 0.0}, r"position_gain must lie in \(0, 1\], got 0.0"),
        ({"position_gain": 1.5}, r"position_gain must lie in \(0, 1\], got 1.5"),
        ({"gravity": float("inf")}, "gravity must be finite"),
        ({"ik_damping": 0.0}, "ik_damping must be positive and finite, got 0.0"),
    ],
)
def test_parameters_out_of_range_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        PhysicsParams(**arguments)


@pytest.mark.parametrize("field", [x.name for x in dataclasses.fields(PhysicsParams)])
def test_a_parameter_that_is_no_number_is_refused_by_name(field):
    with pytest.raises(TypeError, match=rf"^{field} must be a number, got"):
        PhysicsParams(**{field: "1"})


def test_parameters_of_numpy_are_accepted():
    assert PhysicsParams(gravity=np.float32(-1), n_substeps=np.int64(3)).ctrl_dt > 0
    with pytest.raises(TypeError, match=r"^n_substeps must be an integer, got 2\.5"):
        PhysicsParams(n_substeps=2.5)
