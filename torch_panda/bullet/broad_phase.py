"""Plans how resets restore Bullet's broad phase to its state after the scene was built.

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

Bullet has no command that resets this state, but two properties of its commands make
it possible. Setting the collision filter of a link removes the link from the broad
phase and inserts it again at its present pose. Loading a snapshot moves bodies, but
leaves the AABBs in the broad phase as they are. This module takes the snapshots, and
``client_restore`` in ``csrc/reset.c`` gives the commands.
"""

from torch_panda.bullet import capi, structs
from torch_panda.bullet.blueprint import Blueprint, SetCollisionFilter
from torch_panda.bullet.client import PhysicsClient
from torch_panda.rotations import rotate_vector

# Position to which a reset moves all bodies before it inserts their links into the tree
# of AABBs again, one by one [m]. It is so far from the scene that links still waiting
# there do not affect where in the tree Bullet inserts a link of the scene.
_FAR_AWAY = (0.0, 0.0, 10_000.0)
# A reset restores the number of detections modulo this cycle, that is, the lowest 8
# bits of the number. A detection reads one bit per level of the tree, and the trees of
# the shipped tasks have up to 11 levels. 8 bits are a compromise: only the lowest 6 had
# an effect in 120 episodes, and each further bit would double the detections that a
# reset needs.
_DETECTION_CYCLE = 256

_NO_CONTACTS = (0, 0)  # collision group and mask of a link that touches nothing


def plan_restoration(client: PhysicsClient) -> structs.BroadPhase:
    """Plan how to restore the broad phase of a client that was just built.

    This moves the bodies and changes the collision filters. ``client_restore`` brings
    both back.

    Args:
        client: A client whose scene is complete and whose bodies have not moved since
            they were built.
    """
    num_detections = client.num_detections
    bodies = {body: _read_poses(client, body) for body in client.bodies}
    # Filter out all contacts before the first snapshot: loading a snapshot that has
    # contacts would run a collision detection.
    for body, poses in bodies.items():
        for link in range(-1, len(poses) - 1):
            client.set_collision_filter(body, link, *_NO_CONTACTS)
    built = client.save()
    filters = _read_filters(client.blueprint)
    links = []
    for body, poses in bodies.items():
        links += _plan_links(client, body, poses, filters, built)
    for body in bodies:
        client.set_base(body, _FAR_AWAY)
    pair = client.bodies[:2]
    return structs.BroadPhase(
        num_detections=num_detections,
        cycle=_DETECTION_CYCLE,
        away=client.save(),
        built=built,
        num_links=len(links),
        links=(structs.Link * len(links))(*links),
        pair_size=len(pair),
        pair=pair,
    )


def _plan_links(
    client: PhysicsClient,
    body: int,
    poses: list[tuple[float, ...]],
    filters: dict[tuple[int, int], tuple[int, int]],
    built: int,
) -> list[structs.Link]:
    """Plan how to insert a body's base and links.

    Bullet's URDF importer inserts the AABB of a link as if the link's centre of mass
    were at the origin of the link's frame. So the AABB is displaced by the vector from
    the centre of mass to that origin. To insert the same AABB again, a reset loads a
    snapshot in which the whole body is displaced by this vector. This function
    displaces the body for the snapshots and does not move it back.

    If a link's inertial frame is rotated, the importer also inserts the link with a
    different orientation. This function does not imitate that, because no shipped
    robot has such a link. With such a robot, episodes are still reproducible, but
    may differ from episodes in plain pybullet.

    Args:
        client: The client.
        body: Body id.
        poses: Poses of the centres of mass of the base and the links, as built.
        filters: Collision groups and masks that the scene sets, by (body, link).
        built: Id of the snapshot in which all bodies are as built.
    """
    links, base = [], poses[0]
    for link, pose in enumerate(poses, start=-1):
        snapshot = built
        centre = client.inertial_frame(body, link)[:3]
        offset = rotate_vector(pose[3:], centre)
        if any(offset):
            x, y, z = (x - dx for x, dx in zip(base[:3], offset, strict=True))
            client.set_base(body, (x, y, z), base[3:])
            snapshot = client.save()
        is_static = link == -1 and not client.mass(body)
        default = capi.FILTER_STATIC if is_static else capi.FILTER_DYNAMIC
        group, mask = filters.get((body, link), default)
        links.append(structs.Link(body, link, group, mask, snapshot))
    return links


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
