"""PhysicsClient and the pybullet module compute the same numbers."""

import numpy as np
import pybullet
import pybullet_data
import pytest
from pybullet_utils.bullet_client import BulletClient

from torch_panda.bullet import BulletError, PhysicsClient, capi, library


@pytest.fixture
def reference():
    # A client of its own: another test may have left pybullet's default client open.
    client = BulletClient(pybullet.DIRECT)
    client.setAdditionalSearchPath(pybullet_data.getDataPath())
    client.setTimeStep(1 / 500)
    client.setGravity(0, 0, -9.81)
    yield client
    client.disconnect()


def create(reference, client, shape, mass, position):
    shapes = {
        "box": (pybullet.GEOM_BOX, {"halfExtents": (0.02, 0.03, 0.04)}),
        "cylinder": (pybullet.GEOM_CYLINDER, {"radius": 0.03, "height": 0.05}),
        "sphere": (pybullet.GEOM_SPHERE, {"radius": 0.03}),
        "ground": (pybullet.GEOM_BOX, {"halfExtents": (1.0, 1.0, 0.1)}),
    }
    geometry, arguments = shapes[shape]
    theirs = reference.createMultiBody(
        baseMass=mass,
        baseCollisionShapeIndex=reference.createCollisionShape(geometry, **arguments),
        basePosition=position,
    )
    if geometry == pybullet.GEOM_BOX:
        size = arguments["halfExtents"]
        ours = client.create_box(size, mass=mass, position=position)
    elif geometry == pybullet.GEOM_CYLINDER:
        ours = client.create_cylinder(0.03, 0.05, mass=mass, position=position)
    else:
        ours = client.create_sphere(0.03, mass=mass, position=position)
    assert ours == theirs
    return ours


@pytest.mark.parametrize("shape", ["box", "cylinder", "sphere"])
def test_falling_bodies_equal_those_of_pybullet(reference, shape):
    with PhysicsClient() as client:
        ground = create(reference, client, "ground", 0.0, (0.0, 0.0, -0.1))
        body = create(reference, client, shape, 1.0, (0.01, 0.02, 0.2))
        reference.changeDynamics(
            body,
            -1,
            lateralFriction=0.3,
            spinningFriction=0.01,
            rollingFriction=0.002,
        )
        client.set_friction(body, lateral=0.3, spinning=0.01, rolling=0.002)
        rotation = (0.1, 0.2, 0.3, float(np.sqrt(1 - 0.14)))
        velocity, spin = (0.5, 0.1, 0.0), (1.0, 2.0, 3.0)
        reference.resetBasePositionAndOrientation(body, (0.0, 0.0, 0.2), rotation)
        reference.resetBaseVelocity(body, velocity, spin)
        client.set_base(body, (0.0, 0.0, 0.2), rotation, velocity, spin)
        for _ in range(300):
            reference.stepSimulation()
            client.step()
        state = client.state(body)
        position, orientation = reference.getBasePositionAndOrientation(body)
        assert state.base_pose.tolist() == [*position, *orientation]
        linear, angular = reference.getBaseVelocity(body)
        assert state.base_velocity.tolist() == [*linear, *angular]
        theirs = reference.getContactPoints(body, ground)
        ours = client.contact_points(body, ground)
        assert len(theirs) > 0
        assert [tuple(c.position_on_b) for c in ours] == [c[6] for c in theirs]
        assert [c.normal_force for c in ours] == [c[9] for c in theirs]
        assert [c.distance for c in ours] == [c[8] for c in theirs]


def test_ctrl_c_in_close_does_not_free_a_client_twice(monkeypatch):
    freed = []

    def disconnect_and_interrupt(handle, disconnect=capi.disconnect):
        if not freed:
            disconnect(handle)
        freed.append(handle)
        raise KeyboardInterrupt

    client = PhysicsClient()
    monkeypatch.setattr(capi, "disconnect", disconnect_and_interrupt)
    with pytest.raises(KeyboardInterrupt):
        client.close()
    client.close()
    assert len(freed) == 1


@pytest.mark.parametrize(
    ("method", "arguments", "message"),
    [
        ("set_friction", (7,), r"body id must be one of \(0, 1\), got 7"),
        ("set_dynamics", (1, 7), r"body 1 has 7 links .*got 7"),
        ("set_joint_friction", (0, 0, 1.0), "body 0 has 0 joints, .*got 0"),
        ("set_collision_filter", (1, -2, 0, 0), "body 1 has 7 links .*got -2"),
        ("enable_wrench_sensor", (1, -1), "body 1 has 7 joints, .*got -1"),
        ("set_joints", (1, (0, 7), (0, 0), (0, 0)), "body 1 has 7 joints, .*got 7"),
        ("set_base", (-1, (0, 0, 0)), r"body id must be one of \(0, 1\), got -1"),
        ("mass", (0, 0), "body 0 has 0 links .*got 0"),
        ("state", (7,), r"body id must be one of \(0, 1\), got 7"),
    ],
)
def test_bodies_and_links_that_do_not_exist_are_refused(method, arguments, message):
    with PhysicsClient() as client:
        client.create_sphere(0.1, mass=1.0, position=(0, 0, 0))
        client.load_urdf("kuka_iiwa/model.urdf")
        blueprint = client.blueprint
        with pytest.raises(ValueError, match=message):
            getattr(client, method)(*arguments)
        assert client.blueprint == blueprint


def test_a_missing_urdf_is_named():
    with PhysicsClient() as client:
        with pytest.raises(FileNotFoundError, match=r"no_such\.urdf"):
            client.load_urdf("no_such.urdf")
        client.step()


def test_a_missing_symbol_names_the_version_that_works():
    with pytest.raises(ImportError, match=r"b3NoSuch.*pybullet==3\.2\.7"):
        library.bind(library.WORK, "b3NoSuch", None)


def test_a_missing_pybullet_names_the_version_that_works():
    with pytest.raises(ImportError, match=r"not installed.*pybullet==3\.2\.7"):
        library.library_path("no_such_pybullet")


def test_other_status_codes_are_refused(monkeypatch):
    monkeypatch.setattr(capi, "CMD_PERFORM_COLLISION_DETECTION_COMPLETED", 111)
    with pytest.raises(ImportError, match=r"status codes differ.*3\.2\.7"):
        PhysicsClient()


def test_a_client_that_cannot_be_set_up_is_freed(monkeypatch):
    PhysicsClient().close()  # the first client also tests the packed solver
    freed, disconnect = [], capi.disconnect
    monkeypatch.setattr(
        capi, "disconnect", lambda handle: freed.append(handle) or disconnect(handle)
    )
    monkeypatch.setattr(capi, "CMD_CLIENT_COMMAND_COMPLETED", 111)
    with pytest.raises(BulletError, match="could not set parameters"):
        PhysicsClient()
    assert len(freed) == 1


@pytest.mark.parametrize(
    ("group", "mask", "falls"),
    [
        (*capi.FILTER_DYNAMIC, False),
        (*capi.FILTER_STATIC, True),  # two fixed bodies do not touch
        (0, -1, False),
        (1, 0, False),
        (0, 0, True),
    ],
)
def test_collision_filters_act_as_in_pybullet(reference, group, mask, falls):
    with PhysicsClient() as client:
        create(reference, client, "ground", 0.0, (0.0, 0.0, -0.1))
        cube = create(reference, client, "box", 0.3, (0.0, 0.0, 0.05))
        client.set_collision_filter(cube, -1, group, mask)
        reference.setCollisionFilterGroupMask(cube, -1, group, mask)
        for _ in range(200):
            client.step()
            reference.stepSimulation()
        position, _ = reference.getBasePositionAndOrientation(cube)
        assert client.state(cube).base_pose[:3].tolist() == list(position)
        assert (position[2] < -0.1) == falls


def test_a_urdf_with_a_collision_filter_is_refused():
    with PhysicsClient() as client:
        with pytest.raises(ValueError, match=r"cube_collisionfilter\.urdf"):
            client.load_urdf("cube_collisionfilter.urdf")
        assert client.bodies == ()


def test_contact_forces_carry_a_box():
    with PhysicsClient() as client:
        ground = client.create_box((1, 1, 0.1), mass=0.0, position=(0, 0, -0.1))
        box = client.create_box((0.1, 0.1, 0.1), mass=2.0, position=(0, 0, 0.1))
        slope = float(np.sin(0.05)), float(np.cos(0.05))
        client.set_base(ground, (0, 0, -0.1), (slope[0], 0, 0, slope[1]))
        client.set_friction(box, lateral=1.0)
        client.set_friction(ground, lateral=1.0)
        client.step(1500)
        on_box = np.sum([c.force_on_a for c in client.contact_points(box)], axis=0)
        on_ground = np.sum(
            [c.force_on_a for c in client.contact_points(ground)], axis=0
        )
        friction = [np.linalg.norm(c.friction_force) for c in client.contact_points()]
    # On the slope, normal and friction forces together carry the weight.
    assert sum(friction) > 0.5 * 2.0 * 9.81 * np.sin(0.1)
    # The forces that Bullet reports balance the weight to 0.3 %.
    np.testing.assert_allclose(on_box, (0, 0, 2.0 * 9.81), atol=0.1)
    np.testing.assert_allclose(on_ground, -on_box)
