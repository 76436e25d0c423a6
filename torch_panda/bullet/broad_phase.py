"""The way back to the broad phase of a world as it was built.

A step depends on more than poses and velocities: Bullet solves contacts in the order
in which its broad phase found the pairs of bodies, and that order depends on what
happened before. The broad phase holds

* the pairs whose boxes overlap, in an order that additions and removals shuffle;
* a tree of all boxes, whose shape decides the order of pairs that are found together;
* a counter of collision detections, whose bits pick the leaf of the tree that each
  detection inserts anew;
* a mark in the order of pairs, from which each detection looks for pairs that overlap
  no longer.

No command resets them, so each is led back to where it was: by ``reset.c``, and where
that was not compiled by `BroadPhase.restore`, with the same commands.
"""

from ctypes import pointer
from typing import NamedTuple

from torch_panda.bullet import capi, native
from torch_panda.bullet.client import PhysicsClient
from torch_panda.rotations import rotate_vector

# [m]; so much farther than the world is wide that a box put back lands beside those
# that are back already, never among those that still wait.
_FAR_AWAY = (0.0, 0.0, 10_000.0)
# A detection reads one bit of the counter for each level of the tree. Trees of the
# shipped tasks have up to 11 levels, but no episode of 120 changed with bits from 6 on.
_DETECTION_CYCLE = 256

_NOTHING = (0, 0)  # collision group and mask of what touches nothing


class _Link(NamedTuple):
    """A link as its body was built."""

    body: int
    link: int
    group_mask: tuple[int, int]  # collision group and mask
    snapshot: int  # in which the link is where it entered the broad phase


class BroadPhase:
    """A client's broad phase as its world was built, and the way back to it.

    Bodies go back by snapshots, which leave the links' boxes where they are: a link
    enters the broad phase anew when its collision filter is set, and no other one does.

    Args:
        client: a client that will get no more bodies, and whose bodies have not moved
            since they were built.
    """

    def __init__(self, client: PhysicsClient) -> None:
        self._client = client
        self._num_detections = client.num_detections
        self._links: list[_Link] = []
        bodies = {body: _read_poses(client, body) for body in client.bodies}
        # A snapshot with contacts would detect collisions when it is loaded.
        for body, poses in bodies.items():
            for link in range(-1, len(poses) - 1):
                client.set_collision_filter(body, link, *_NOTHING)
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
        """Put all bodies where they were built, and make Bullet forget the rest.

        Takes each link out of the broad phase and puts them back one by one, in the
        order in which they were built. What is put in anew has no overlaps and no
        contacts, and once nothing of the old tree is near, the tree of what is back
        depends on the way back alone.
        """
        client = self._client
        client.load(self._away)
        # Links overlap there, too, unless they touch nothing.
        for body, link, _, _ in self._links:
            client.set_collision_filter(body, link, *_NOTHING)
        # A detection that finds a single pair puts the mark at the first one.
        for body in self._pair:
            client.set_collision_filter(body, -1, *capi.FILTER_DYNAMIC)
        client.detect_collisions()
        for body in self._pair:
            client.set_collision_filter(body, -1, *_NOTHING)
        # Cheap here, where nothing overlaps: about 1 us each.
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
        """Find how the loader added a body's base and links to the broad phase.

        It adds each one with its centre of mass at the origin of its frame, and when it
        has added the last, moves them to their places, but not their boxes. That it
        also turns those whose inertial frame is turned, as in no shipped robot, is not
        repeated: then what follows is always the same, but not as in a new client.
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
            group_mask = capi.FILTER_STATIC if is_static else capi.FILTER_DYNAMIC
            self._links.append(_Link(body, link, group_mask, snapshot))


def _read_poses(client: PhysicsClient, body: int) -> list[tuple[float, ...]]:
    """Poses of the centres of mass of a body's base and links."""
    state = client.state(body)
    return [tuple(pose.tolist()) for pose in (state.base_pose, *state.link_poses)]
