"""A camera, and the distances that it sees."""

import dataclasses
import operator
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from torch_panda.rotations import rotate_vector

# The depth of a pixel in which nothing is seen, up to rounding.
_BACKGROUND_DEPTH = np.float32(1 - 1e-6)


@dataclass(frozen=True)
class Camera:
    """A pinhole camera; the defaults are panda-gym's.

    Attributes:
        target: the point it looks at, world frame [m].
        distance: from there [m].
        yaw: its direction, about the world's z axis [degrees].
        pitch: above the horizon, so a negative one looks down [degrees].
        roll: about the line of sight [degrees].
        fov: vertical angle of view [degrees].
        width: of the image [pixels].
        height: of the image [pixels].
        near: nothing closer along the line of sight is seen [m].
        far: nor anything farther [m].
        shadows: whether bodies cast shadows. Bullet's software renderer then draws the
            scene twice: without them a picture takes half the time.

    Raises:
        ValueError: a size, a distance or an angle is out of range.
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
        if min(self.width, self.height) < 1:
            raise ValueError(
                f"a camera's width and height must be at least 1 pixel, got "
                f"{self.width} x {self.height}"
            )
        if not 0 < self.fov < 180:
            raise ValueError(f"fov must be between 0 and 180 degrees, got {self.fov}")
        if not (0 < self.near < self.far and self.distance > 0):
            raise ValueError(
                f"distance must be above 0, and near between 0 and far, got distance "
                f"{self.distance}, near {self.near}, far {self.far}"
            )


@dataclass(frozen=True)
class HandCamera(Camera):
    """A camera that moves with the end-effector, in whose frame it is described.

    The Panda's frame lies between its fingertips, with z pointing out of the hand and y
    from finger to finger; the defaults look past both fingers.

    Attributes:
        eye: where it is [m].
        target: the point it looks at [m].
        up: the direction that is up in the picture.
        distance: from eye to target, whatever is given; ``yaw``, ``pitch`` and ``roll``
            are not used.

    Raises:
        ValueError: up is the line of sight; or as for `Camera`.
    """

    eye: tuple[float, float, float] = (0.08, 0.0, -0.12)
    target: tuple[float, float, float] = (0.01, 0.0, 0.03)
    up: tuple[float, float, float] = (1.0, 0.0, 0.0)
    fov: float = 75.0
    near: float = 0.01
    far: float = 5.0

    def __post_init__(self) -> None:
        sight = np.subtract(self.target, self.eye)
        if np.linalg.norm(np.cross(sight, self.up)) < 1e-6:
            raise ValueError(
                f"up must not be the line of sight, got {self.up}, from {self.eye} to "
                f"{self.target}"
            )
        object.__setattr__(self, "distance", float(np.linalg.norm(sight)))
        super().__post_init__()

    def placed(
        self, hand: Sequence[float]
    ) -> tuple[Sequence[float], Sequence[float], Sequence[float]]:
        """Eye, target and up in the world frame.

        Args:
            hand: (7,), position [m] and quaternion xyzw of the end-effector.
        """
        position, rotation = hand[:3], hand[3:]
        eye, target = (
            [
                x + dx
                for x, dx in zip(position, rotate_vector(rotation, point), strict=True)
            ]
            for point in (self.eye, self.target)
        )
        return eye, target, rotate_vector(rotation, self.up)


def resized(camera: Camera, size: int | tuple[int, int] | None) -> Camera:
    """The same view in another size: (height, width), or both in one; None: as is.

    Raises:
        ValueError: it is no such size.
    """
    if size is None:
        return camera
    try:
        height, width = map(operator.index, np.broadcast_to(size, 2))
    except (TypeError, ValueError):
        raise ValueError(
            f"a size must be an integer or (height, width) [pixels], got {size!r}"
        ) from None
    return dataclasses.replace(camera, height=height, width=width)


def to_metres(
    depth: npt.NDArray[np.float32], camera: Camera
) -> npt.NDArray[np.float32]:
    """Distance along the line of sight [m] of an `Image`'s depth.

    The inverse of OpenGL's perspective projection.
    """
    near, far = np.float32(camera.near), np.float32(camera.far)
    metres = near * far / (far - (far - near) * depth)
    return np.where(depth < _BACKGROUND_DEPTH, metres, far)
