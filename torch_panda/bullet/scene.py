"""What a client holds, by body ids."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Scene:
    """What a simulation moves and reads; the same ids in every client.

    Attributes:
        robot: body id of the robot.
        joints: indices of its movable joints.
        ee_link: its link whose centre of mass is the end-effector.
        objects: body ids of the movable objects.
        object_joints: of each object the indices of its movable joints.
        markers: body ids of the markers that show where the objects should go.
    """

    robot: int
    joints: tuple[int, ...]
    ee_link: int
    objects: tuple[int, ...] = ()
    object_joints: tuple[tuple[int, ...], ...] = ()
    markers: tuple[int, ...] = ()
