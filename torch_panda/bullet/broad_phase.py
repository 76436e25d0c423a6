"""Restores Bullet's broad phase to its state after the scene was built.

The broad phase is the part of collision detection that finds pairs of links whose
axis-aligned bounding boxes (AABBs) overlap. If the broad phase finds one pair
before another, Bullet also solves its contacts first. Earlier steps and episodes
influence which pair is found first. So two worlds with equal poses and velocities can
step differently.

The state of the broad phase consists of

* the list of overlapping pairs, whose order changes when pairs are added or removed;
* the tree of all AABBs, whose shape determines the order in which pairs are found;
* the number of collision detections so far. Each detection reinserts one leaf of the
  tree. The bits of this number choose the path from the root to that leaf;
* a cursor in the list of pairs. Each detection removes pairs that no longer overlap,
  and starts to look for them at the cursor.

Bullet has no command that resets this state. `BroadPhase.restore` resets it by a
sequence of other commands. ``reset.c`` gives the same commands from C.
"""

from ctypes import pointer
from typing import NamedTuple

from torch_panda.bullet import capi, native
from torch_panda.bullet.blueprint import Blueprint, SetCollisionFilter
from torch_panda.bullet.client import PhysicsClient
from torch_panda.rotations import rotate_vector

# Position to which `restore` moves all bodies before it inserts their links into the
# tree of AABBs again, one by one [m]. It is so far from the scene that links still
# waiting there do not affect where in the tree Bullet inserts a link of the scene.
_FAR_AWAY = (0.0, 0.0, 10_000.0)
# `restore` restores the number of detections modulo this cycle, that is, the lowest 8
# bits of the number. A detection reads one bit per level of the tree, and the trees of
# the shipped tasks have up to 11 levels. 8 bits are a compromise: only the lowest 6 had
# an effect in 120 episodes, and each further bit would double the detections that a
# reset needs.
_DETECTION_CYCLE = 256

_NO_CONTACTS = (0, 0)  # collision group and mask of a link that touches nothing


class _Link(NamedTuple):
    """A link, and how `restore` inserts it into the broad phase."""

    body: int
    link: int
    group_mask: tuple[int, int]  # collision group and mask
    snapshot: int  # id of the snapshot to load before the link is inserted


class BroadPhase:
    """Restores a client's broad phase to its state after the scene was built.

    Two properties of Bullet's commands make this possible. Setting the collision
    filter of a link removes the link from the broad phase and inserts it again at its
    present pose. Loading a snapshot moves bodies, but leaves the AABBs in the broad
    phase as they are.

    Args:
        client: A client whose scene is complete and whose bodies have not moved since
            they were built.
    """

    def __init__(self, client: PhysicsClient) -> None:
        self._client = client
        self._num_detections = client.num_detections
        self._links: list[_Link] = []
        self._filters = _read_filters(client.blueprint)
        bodies = {body: _read_poses(client, body) for body in client.bodies}
        # Filter out all contacts before the first snapshot: loading a snapshot that has
        # contacts would run a collision detection.
        for body, poses in bodies.items():
            for link in range(-1, len(poses) - 1):
                client.set_collision_filter(body, link, *_NO_CONTACTS)
        self._built = client.save()
        for body, poses in bodies.items():
            self._plan_links(body, poses)
        for body in bodies:
            client.set_base(body, _FAR_AWAY)
        self._away = client.save()
        # The two bodies whose overlap moves the cursor to the start; see `restore`.
        self._pair = client.bodies[:2]
        client.native.broad_phase = pointer(self._describe())
        self.restore()

    def restore(self) -> None:
        """Move all bodies to where they were built and restore the broad phase.

        All bodies are first moved far away. Then one link after another is inserted at
        the pose at which it was built, in the order in which the links were built. Its
        old overlaps and contacts are lost.
        """
        client = self._client
        client.load(self._away)
        # All bodies are at the same position now, so filter out all pairs of links.
        for body, link, _, _ in self._links:
            client.set_collision_filter(body, link, *_NO_CONTACTS)
        # Move the cursor back to the start of the list of pairs. A detection advances
        # the cursor modulo the number of pairs, so with exactly one pair it becomes 0.
        for body in self._pair:
            client.set_collision_filter(body, -1, *capi.FILTER_DYNAMIC)
        client.detect_collisions()
        for body in self._pair:
            client.set_collision_filter(body, -1, *_NO_CONTACTS)
        # Run detections until their number is that after building, modulo the cycle.
        # While nothing overlaps, a detection takes about 1 us.
        num_since_built = client.num_detections - self._num_detections
        client.detect_collisions(-num_since_built % _DETECTION_CYCLE)
        for body, link, group_mask, snapshot in self._links:
            client.load(snapshot)
            client.set_collision_filter(body, link, *group_mask)
        client.load(self._built)

    def _describe(self) -> native.BroadPhase:
        """The struct with which ``reset.c`` does the same as `restore`."""
        links = [
            native.Link(body, link, *group_mask, snapshot)
            for body, link, group_mask, snapshot in self._links
        ]
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

    def _plan_links(self, body: int, poses: list[tuple[float, ...]]) -> None:
        """Append a body's base and links to the list of links to insert.

        Bullet's URDF importer inserts the AABB of a link as if the link's centre of
        mass were at the origin of the link's frame. So the AABB is displaced by the
        vector from the centre of mass to that origin. To insert the same AABB again,
        `restore` loads a snapshot in which the whole body is displaced by this vector.
        This method displaces the body for the snapshots and does not move it back.

        If a link's inertial frame is rotated, the importer also inserts the link with a
        different orientation. This method does not imitate that, because no shipped
        robot has such a link. With such a robot, episodes are still reproducible, but
        may differ from episodes in plain pybullet.
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
    """Collision groups and masks that a scene sets, by (body, link)."""
    return {
        (command.body, command.link): (command.group, command.mask)
        for command in blueprint
        if isinstance(command, SetCollisionFilter)
    }


def _read_poses(client: PhysicsClient, body: int) -> list[tuple[float, ...]]:
    """Poses of the centres of mass of a body's base and links."""
    state = client.state(body)
    return [tuple(pose.tolist()) for pose in (state.base_pose, *state.link_poses)]
