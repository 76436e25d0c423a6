"""The way back to a world as it was built, as far as Bullet remembers it.

A step depends on more than poses and velocities: Bullet solves contacts in the order
in which its broad phase found the pairs of bodies, and that order depends on what
happened before. The broad phase holds

* the pairs whose boxes overlap, in an order that additions and removals shuffle;
* a tree of all boxes, whose shape decides the order of pairs that are found together;
* a counter of collision detections, whose bits pick the leaf of the tree that each
  detection inserts anew.

No command resets them, so each is led back to where it was.
"""

from typing import NamedTuple

from torch_panda.bullet import _capi
from torch_panda.bullet.client import PhysicsClient, read_doubles

# [m]; so much farther than the world is wide that a box put back lands beside those
# that are back already, never among those that still wait.
_FAR_AWAY = 10_000.0
# A detection reads one bit of the counter for each level of the tree. Trees of the
# shipped tasks have up to 11 levels, but no episode of 120 changed with bits from 6 on.
_DETECTION_CYCLE = 256

_NOTHING = (0, 0)  # collision group and mask of what touches nothing


class _Body(NamedTuple):
    """A body as it was built."""

    body: int
    position: tuple[float, ...]  # of the base, world frame [m]
    orientation: tuple[float, ...]  # quaternion xyzw
    joints: tuple[int, ...]  # the movable ones
    joint_positions: tuple[float, ...]  # [rad] or [m]
    filters: tuple[tuple[int, int, int], ...]  # link, collision group and mask


class BuiltWorld:
    """What a client has built so far, and the way back to it.

    Args:
        client: a client that will get no more bodies.
    """

    def __init__(self, client: PhysicsClient) -> None:
        self._client = client
        self._bodies = tuple(_read(client, body) for body in client.bodies)

    def restore(self) -> None:
        """Put all bodies where they were built, and make Bullet forget the rest.

        Takes each body out of the broad phase and puts them back one by one, in the
        order in which they were built. What is put in anew has no overlaps and no
        contacts, and once nothing of the old tree is near, the tree of what is back
        depends on the way back alone.
        """
        client = self._client
        for body, (
            x,
            y,
            z,
        ), orientation, joints, joint_positions, filters in self._bodies:
            if joints:
                client.set_joints(body, joints, joint_positions, (0.0,) * len(joints))
            client.set_base(body, (x, y, z + _FAR_AWAY), orientation)
            # Links of one body overlap wherever it is, unless they touch nothing.
            for link, _, _ in filters:
                client.set_collision_filter(body, link, *_NOTHING)
        # Cheap here, where nothing overlaps: about 1 us each.
        client.detect_collisions(-client.num_detections % _DETECTION_CYCLE)
        for body, position, orientation, _, _, filters in self._bodies:
            client.set_base(body, position, orientation)
            for link, group, mask in filters:
                client.set_collision_filter(body, link, group, mask)


def _read(client: PhysicsClient, body: int) -> _Body:
    joints = client.joints(body)
    movable = tuple(joint.index for joint in joints if joint.is_movable)
    state = client.state(body)
    pose = read_doubles(state.q, 7)
    base = _capi.FILTER_DYNAMIC if client.mass(body) else _capi.FILTER_STATIC
    links = ((joint.index, *_capi.FILTER_DYNAMIC) for joint in joints)
    return _Body(
        body=body,
        position=pose[:3],
        orientation=pose[3:],
        joints=movable,
        joint_positions=read_doubles(state.joint_positions, len(movable)),
        filters=((-1, *base), *links),
    )
