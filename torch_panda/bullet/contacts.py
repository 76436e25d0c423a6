"""Contact points of two bodies, with their forces."""

from typing import NamedTuple

from torch_panda.bullet import capi
from torch_panda.bullet.blueprint import Vector


class ContactPoint(NamedTuple):
    """A contact of two bodies; vectors are in the world frame."""

    body_a: int
    body_b: int
    link_a: int
    link_b: int
    position_on_a: Vector  # [m]
    position_on_b: Vector  # [m]
    normal_on_b: Vector  # points from b to a
    distance: float  # [m], negative where the bodies penetrate
    normal_force: float  # [N], on a along normal_on_b; b gets the opposite force
    friction_force: Vector  # [N], on a; b gets the opposite force

    @property
    def force_on_a(self) -> Vector:
        """Normal and friction force that body b exerts on body a [N]."""
        x, y, z = (
            self.normal_force * n + f
            for n, f in zip(self.normal_on_b, self.friction_force, strict=True)
        )
        return x, y, z

    def swapped(self) -> "ContactPoint":
        """The same contact with a and b exchanged."""
        return ContactPoint(
            self.body_b,
            self.body_a,
            self.link_b,
            self.link_a,
            self.position_on_b,
            self.position_on_a,
            _negative(self.normal_on_b),
            self.distance,
            self.normal_force,
            _negative(self.friction_force),
        )


def read_contact(point: capi.ContactPoint) -> ContactPoint:
    """Convert Bullet's struct of a contact point."""
    friction = (
        point.friction_force_1 * d1 + point.friction_force_2 * d2
        for d1, d2 in zip(
            point.friction_direction_1, point.friction_direction_2, strict=True
        )
    )
    return ContactPoint(
        point.body_a,
        point.body_b,
        point.link_a,
        point.link_b,
        tuple(point.position_on_a),
        tuple(point.position_on_b),
        tuple(point.normal_on_b),
        point.distance,
        point.normal_force,
        tuple(friction),
    )


def _negative(vector: Vector) -> Vector:
    x, y, z = vector
    return -x, -y, -z
