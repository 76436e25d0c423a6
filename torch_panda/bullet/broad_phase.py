"""Restores Bullet's broad phase to its state after the scene was built.

A step depends on more than poses and velocities. Its broad phase finds pairs of bodies
in an order that depends on the past, and Bullet solves contacts in this order. The
state of the broad phase consists of

* the pairs whose AABBs overlap, in an order that additions and removals shuffle;
* a tree of all AABBs, whose shape determines the order of pairs found together;
* a counter of collision detections, whose bits choose the leaf of the tree that each
  detection inserts again;
* a cursor in the list of pairs, at which each detection starts to look for pairs that
  no longer overlap.

No command of Bullet resets this state. `BroadPhase.restore` does it by a sequence of
commands. ``reset.c`` gives the same commands from C.
"""

from ctypes import pointer
from typing import NamedTuple

from torch_panda.bullet import capi, native
from torch_panda.bullet.blueprint import Blueprint, SetCollisionFilter
from torch_panda.bullet.client import PhysicsClient
from torch_panda.rotations import rotate_vector

# Where bodies wait until they are inserted again [m]. The distance is much larger than
# the scene, so that Bullet inserts an AABB beside those in the scene, and never among
# the waiting ones.
_FAR_AWAY = (0.0, 0.0, 10_000.0)
# A detection reads one bit of the counter per level of the tree. Trees of the shipped
# tasks have up to 11 levels. In 120 episodes, bits from the seventh on had no effect.
_DETECTION_CYCLE = 256

_NO_CONTACTS = (0, 0)  # collision group and mask of a link that touches nothing


class _Link(NamedTuple):
    """The collision filter and pose with which a link entered the broad phase."""

    body: int
    link: int
    group_mask: tuple[int, int]  # collision group and mask
    snapshot: int  # has the link at the pose at which it entered the broad phase


class BroadPhase:
    """Restores a client's broad phase to its state after the scene was built.

    Loading a snapshot moves bodies without updating their AABBs. A link therefore
    enters the broad phase exactly when its collision filter is set.

    Args:
        client: A client that gets no more bodies, and whose bodies have not moved
            since they were built.
    """

    def __init__(self, client: PhysicsClient) -> None:
        self._client = client
        self._num_detections = client.num_detections
        self._links: list[_Link] = []
        self._filters = _read_filters(client.blueprint)
        bodies = {body: _read_poses(client, body) for body in client.bodies}
        # Filter out all contacts first, because loading a snapshot with contacts would
        # detect collisions.
        for body, poses in bodies.items():
            for link in range(-1, len(poses) - 1):
                client.set_collision_filter(body, link, *_NO_CONTACTS)
        self._built = client.save()
        for body, poses in bodies.items():
            self._read_links(body, poses)
        for body in bodies:
            client.set_base(body, _FAR_AWAY)
        self._away = client.save()
        self._pair = client.bodies[:2]
        client.native.broad_phase = pointer(self._describe())
        self.restore()

    def restore(self) -> None:
        """Move all bodies to where they were built and restore the broad phase.

        All links leave the broad phase and enter it one by one, in the order in which
        they were built. A link that enters has no overlaps and no contacts. Because the
        old tree is far away, the new tree depends on this sequence only.
        """
        client = self._client
        client.load(self._away)
        # All links wait at one place and overlap there, so filter their pairs out.
        for body, link, _, _ in self._links:
            client.set_collision_filter(body, link, *_NO_CONTACTS)
        # A detection that finds a single pair moves the cursor to the first pair.
        for body in self._pair:
            client.set_collision_filter(body, -1, *capi.FILTER_DYNAMIC)
        client.detect_collisions()
        for body in self._pair:
            client.set_collision_filter(body, -1, *_NO_CONTACTS)
        # Detections are cheap while nothing overlaps: about 1 us.
        past = client.num_detections - self._num_detections
        client.detect_collisions(-past % _DETECTION_CYCLE)
        for body, link, group_mask, snapshot in self._links:
            client.load(snapshot)
            client.set_collision_filter(body, link, *group_mask)
        client.load(self._built)

    def _describe(self) -> native.BroadPhase:
        links = [native.Link(b, k, *filters, s) for b, k, filters, s in self._links]
        return native.BroadPhase(
            self._num_detections,
            _DETECTION_CYCLE,
            self._away,
            self._built,
            len(links),
            len(self._pair),
            self._pair,
            (native.Link * len(links))(*links),
        )

    def _read_links(self, body: int, poses: list[tuple[float, ...]]) -> None:
        """Append a body's base and links, each as it entered the broad phase.

        The importer adds every link with its centre of mass at the origin of the link's
        frame. In the end it moves the links to their poses, but not their AABBs. It
        also rotates links whose inertial frame is rotated. This is not repeated here,
        because no shipped robot has such links: episodes with such a robot are
        reproducible, but differ from the first episode of a new client.
        """
        client, base = self._client, poses[0]
        for link, pose in enumerate(poses, start=-1):
            snapshot = self._built
            offset = rotate_vector(pose[3:], client.centre_of_mass(body, link))
            if any(offset):
                x, y, z = (x - dx for x, dx in zip(base[:3], offset, strict=True))
                client.set_base(body, (x, y, z), base[3:])
                snapshot = client.save()
            is_static = link == -1 and not client.mass(body)
            default = capi.FILTER_STATIC if is_static else capi.FILTER_DYNAMIC
            group_mask = self._filters.get((body, link), default)
            self._links.append(_Link(body, link, group_mask, snapshot))


def _read_filters(blueprint: Blueprint) -> dict[tuple[int, int], tuple[int, int]]:
    """Collision group and mask of the links, by body and link, that a scene sets."""
    return {
        (command.body, command.link): (command.group, command.mask)
        for command in blueprint
        if isinstance(command, SetCollisionFilter)
    }


def _read_poses(client: PhysicsClient, body: int) -> list[tuple[float, ...]]:
    """Poses of the centres of mass of a body's base and links."""
    state = client.state(body)
    return [tuple(pose.tolist()) for pose in (state.base_pose, *state.link_poses)]
