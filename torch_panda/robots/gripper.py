"""Fingers that open and close together."""

from dataclasses import dataclass, field

import torch
from torch import Tensor


@dataclass(frozen=True)
class Gripper:
    """Fingers that open and close together, moved by a robot's last joints.

    Attributes:
        closed: positions of these joints where the fingers touch [rad] or [m].
        opened: where they are as far apart as they go; a joint that stays is the same.
        width: the distance between the fingers there [m].
        scale: how much farther apart an action of 1 sends them [m].
        followers: indices of the joints that a real gripper couples to the others,
            which Bullet's simulation does not: they go where the others are.

    Raises:
        ValueError: no joint moves, or the numbers of joints differ.
    """

    closed: tuple[float, ...]
    opened: tuple[float, ...]
    width: float
    scale: float = 0.2
    followers: tuple[int, ...] = ()
    # The width is the joints times these, and an offset; and how far all move with it.
    _weights: Tensor = field(init=False, repr=False, compare=False)
    _offset: float = field(init=False, repr=False, compare=False)
    _per_width: Tensor = field(init=False, repr=False, compare=False)
    _closed: Tensor = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        double = torch.float64
        closed = torch.tensor(self.closed, dtype=double, device="cpu")
        opened = torch.tensor(self.opened, dtype=double, device="cpu")
        if closed.shape != opened.shape or not (closed != opened).any():
            raise ValueError(
                f"closed and opened must be of the same joints, of which one moves, "
                f"got {self.closed} and {self.opened}"
            )
        if not self.width > 0:
            raise ValueError(f"width must be above 0 [m], got {self.width}")
        per_width = (opened - closed) / self.width
        leads = closed != opened
        leads[list(self.followers)] = False
        if not leads.any():
            raise ValueError(f"not all joints can follow, got {self.followers}")
        weights = torch.where(leads, 1 / per_width, 0.0) / leads.sum()
        object.__setattr__(self, "_closed", closed)
        object.__setattr__(self, "_per_width", per_width)
        object.__setattr__(self, "_weights", weights)
        object.__setattr__(self, "_offset", -float((closed * weights).sum()))

    @property
    def num_joints(self) -> int:
        """Number of joints."""
        return len(self.closed)

    def fingers_width(self, joints: Tensor) -> Tensor:
        """Distance between the fingers [m]: (n, num_joints) -> (n, 1)."""
        return (joints * self._weights).sum(dim=1, keepdim=True) + self._offset

    def setpoint(self, action: Tensor, joints: Tensor) -> Tensor:
        """Where an action sends the joints.

        Args:
            action: (n, 1) float32 in [-1, 1].
            joints: (n, num_joints) float64, where they are.

        Returns:
            (n, num_joints), float64.
        """
        # In float32 throughout: so panda-gym computes it under NumPy 2.
        width = self.fingers_width(joints)
        wanted = width.float() + action * self.scale
        setpoint = self._closed + wanted.double() * self._per_width
        if self.followers:
            followers = list(self.followers)
            setpoint[:, followers] = (self._closed + width * self._per_width)[
                :, followers
            ]
        return setpoint
