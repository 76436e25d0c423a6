"""Commands that build and place bodies, in physics clients and in visual clients."""

import threading
from collections.abc import Sequence

from torch_panda.bullet import capi
from torch_panda.bullet.blueprint import Vector
from torch_panda.bullet.connection import Connection, doubles
from torch_panda.rotations import NO_ROTATION

ORIGIN: Vector = (0.0, 0.0, 0.0)
NO_SHAPE = -1

# All clients share the caches of Bullet's URDF importer, so two threads that load URDFs
# at the same time would crash.
_IMPORTER = threading.Lock()


def load_urdf(
    connection: Connection,
    file: str,
    position: Sequence[float],
    orientation: Sequence[float],
    *,
    fixed_base: bool,
    flags: int,
) -> int:
    """Load a URDF with flags of ``enum eURDF_Flags`` and return its body id."""
    command = capi.urdf_init(connection.handle, file.encode())
    capi.urdf_set_position(command, *position)
    capi.urdf_set_orientation(command, *orientation)
    capi.urdf_set_fixed_base(command, int(fixed_base))
    capi.urdf_set_flags(command, flags)
    with _IMPORTER:
        status = connection.submit(
            command,
            capi.CMD_URDF_LOADING_COMPLETED,
            f"load {file} (it prints the reason)",
        )
    return int(capi.status_body(status))


def create_body(
    connection: Connection,
    position: Vector,
    *,
    mass: float = 0.0,
    collision_shape: int = NO_SHAPE,
    visual_shape: int = NO_SHAPE,
) -> int:
    """Create a body of one link and return its id."""
    rotation, origin = doubles(NO_ROTATION), doubles(ORIGIN)
    command = capi.body_init(connection.handle)
    capi.body_set_base(
        command,
        mass,
        collision_shape,
        visual_shape,
        doubles(position),
        rotation,
        origin,
        rotation,
    )
    status = connection.submit(
        command, capi.CMD_CREATE_MULTI_BODY_COMPLETED, "create a body"
    )
    return int(capi.status_body(status))


def set_base(
    connection: Connection,
    body: int,
    position: Sequence[float],
    orientation: Sequence[float],
    linear_velocity: Sequence[float] = ORIGIN,
    angular_velocity: Sequence[float] = ORIGIN,
) -> None:
    """Move a body; see `PhysicsClient.set_base`."""
    command = capi.pose_init(connection.handle, body)
    capi.pose_set_linear_velocity(command, doubles(linear_velocity))
    capi.pose_set_angular_velocity(command, doubles(angular_velocity))
    capi.pose_set_position(command, *position)
    capi.pose_set_orientation(command, *orientation)
    connection.submit(command, capi.CMD_CLIENT_COMMAND_COMPLETED, "set a base pose")


def set_joints(
    connection: Connection,
    body: int,
    joints: Sequence[int],
    positions: Sequence[float],
    velocities: Sequence[float],
) -> None:
    """Move joints of a body; see `PhysicsClient.set_joints`."""
    handle = connection.handle
    command = capi.pose_init(handle, body)
    for joint, position, velocity in zip(joints, positions, velocities, strict=True):
        capi.pose_set_joint_position(handle, command, joint, position)
        capi.pose_set_joint_velocity(handle, command, joint, velocity)
    connection.submit(command, capi.CMD_CLIENT_COMMAND_COMPLETED, "set joints")
