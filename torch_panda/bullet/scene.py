"""Body ids of a scene."""

from typing import NamedTuple


class Scene(NamedTuple):
    """Ids of the bodies that a simulation moves and reads, the same in every client.

    Attributes:
        robot: Body id of the robot.
        joints: Indices of the robot's movable joints.
        ee_link: Link of the robot whose centre of mass is the end-effector.
        objects: Body ids of the objects that a reset places.
        object_joints: Indices of the movable joints of every object.
        markers: Body ids of the markers that show the goal.
    """

    robot: int
    joints: tuple[int, ...]
    ee_link: int
    objects: tuple[int, ...] = ()
    object_joints: tuple[tuple[int, ...], ...] = ()
    markers: tuple[int, ...] = ()
