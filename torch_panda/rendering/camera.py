"""Cameras: where they are and what they see."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from torch_panda.checks import (
    check_above_zero,
    check_finite,
    check_instance,
    check_integer,
    check_vector,
)
from torch_panda.rotations import rotate_vector

# Depths from here on are background, whose depth is 1 up to rounding.
_BACKGROUND_DEPTH = np.float32(1 - 1e-6)


@dataclass(frozen=True)
class Camera:
    """A pinhole camera. The defaults are panda-gym's.

    Attributes:
        target: Point at which the camera looks, world frame [m].
        distance: Distance of the camera from the target [m].
        yaw: Direction of the view about the world's z axis [degrees].
        pitch: Elevation of the view; negative looks down [degrees].
        roll: Rotation about the line of sight [degrees].
        fov: Vertical angle of view [degrees].
        width: Width of the image [pixels].
        height: Height of the image [pixels].
        near: Distance below which nothing is visible [m], along the line of sight.
        far: Distance above which nothing is visible [m], along the line of sight.
        shadows: Whether bodies cast shadows. Bullet's software renderer renders the
            scene twice for them, so a picture without shadows takes half the time.

    Raises:
        ValueError: A size, a distance or an angle is out of range.
        TypeError: A size is not an integer, or another argument is not a number.
    """

    target: tuple[float, float, float] = (0.0, 0.0, 0.0)
    distance: float = 1.4
    yaw: float = 45.0
    pitch: float = -30.0
    roll: float = 0.0
    fov: float = 60.0
    width: int = 720
    height: int = 480
    near: float = 0.1
    far: float = 100.0
    shadows: bool = True

    def __post_init__(self) -> None:
        check_vector("target", self.target)
        check_finite(yaw=self.yaw, pitch=self.pitch, roll=self.roll)
        check_above_zero(
            distance=self.distance,
            fov=self.fov,
            near=self.near,
            far=self.far,
            width=check_integer("width", self.width),
            height=check_integer("height", self.height),
        )
        if not self.fov < 180:
            raise ValueError(f"fov must be below 180 degrees, got {self.fov}")
        if not self.near < self.far:
            raise ValueError(
                f"near must be below far, got near {self.near} and far {self.far}"
            )


@dataclass(frozen=True)
class HandCamera(Camera):
    """A camera that moves with the end-effector.

    Its position and direction are given in the frame of the end-effector. The origin of
    the Panda's frame lies between the fingertips. Its z axis points out of the hand,
    and its y axis points from one finger to the other. By default the camera sees both
    fingers.

    Attributes:
        eye: Position of the camera [m].
        target: Point at which the camera looks [m].
        up: Direction that is up in the picture.
        distance: Distance from ``eye`` to ``target``, computed from the two. ``yaw``,
            ``pitch`` and ``roll`` are not used.

    Raises:
        ValueError: ``up`` is parallel to the line of sight, or an argument of `Camera`
            is out of range.
    """

    eye: tuple[float, float, float] = (0.08, 0.0, -0.12)
    target: tuple[float, float, float] = (0.01, 0.0, 0.03)
    up: tuple[float, float, float] = (1.0, 0.0, 0.0)
    fov: float = 75.0
    near: float = 0.01
    far: float = 5.0

    def __post_init__(self) -> None:
        for name in ("eye", "target", "up"):
            check_vector(name, getattr(self, name))
        sight = np.subtract(self.target, self.eye)
        if np.linalg.norm(np.cross(sight, self.up)) < 1e-6:
            raise ValueError(
                f"up must not be parallel to the line of sight, got up {self.up}, eye "
                f"{self.eye}, target {self.target}"
            )
        object.__setattr__(self, "distance", float(np.linalg.norm(sight)))
        super().__post_init__()

    def in_world(
        self, ee_pose: Sequence[float]
    ) -> tuple[Sequence[float], Sequence[float], Sequence[float]]:
        """Eye, target and up in the world frame.

        Args:
            ee_pose: Pose of the end-effector (7,): position [m] and quaternion xyzw.
        """
        position, rotation = ee_pose[:3], ee_pose[3:]
        eye, target = (
            [
                x + dx
                for x, dx in zip(position, rotate_vector(rotation, point), strict=True)
            ]
            for point in (self.eye, self.target)
        )
        return eye, target, rotate_vector(rotation, self.up)


def resized(camera: Camera, size: int | tuple[int, int] | None) -> Camera:
    """Copy a camera with another size of the image.

    Args:
        camera: The camera.
        size: Height and width, or one number for both [pixels]; None keeps the size.

    Raises:
        ValueError: The size is not one or two numbers, or one of them is below 1.
        TypeError: A number is not an integer, or the camera is not a `Camera`.
    """
    check_instance("camera", camera, Camera)
    if size is None:
        return camera
    sizes = np.atleast_1d(size).tolist()
    if len(sizes) not in (1, 2):
        raise ValueError(f"size must be one or two numbers, got {size}")
    height, width = sizes[0], sizes[-1]
    return dataclasses.replace(camera, height=height, width=width)


def to_metres(
    depth: npt.NDArray[np.float32], camera: Camera
) -> npt.NDArray[np.float32]:
    """Convert the depth of an `Image` to distances along the line of sight [m].

    This is the inverse of OpenGL's perspective projection. The background gets ``far``.
    """
    near, far = np.float32(camera.near), np.float32(camera.far)
    metres = near * far / (far - (far - near) * depth)
    return np.where(depth < _BACKGROUND_DEPTH, metres, far)
