"""Grippers whose fingers open and close together."""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from torch_panda.checks import check_above_zero, check_finite


@dataclass(frozen=True)
class Gripper:
    """A gripper whose fingers open and close together, moved by a robot's last joints.

    Attributes:
        closed: Positions of these joints when the fingers touch [rad] or [m].
        opened: Positions of these joints when the fingers are fully open. A joint that
            does not move has the same position in both.
        width: Distance between the fully open fingers [m].
        scale: Change of the distance for an action of 1 [m].
        mimic_joints: Indices of joints that a real gripper couples mechanically to the
            others. Bullet does not couple them, so their setpoints are the positions
            that match the present distance between the fingers.

    Raises:
        ValueError: The lengths of ``closed`` and ``opened`` differ, no joint moves, all
            joints follow, or a number is out of range.
    """

    closed: tuple[float, ...]
    opened: tuple[float, ...]
    width: float
    scale: float = 0.2
    mimic_joints: tuple[int, ...] = ()
    # The width is the joint positions times _weights, plus _offset. The joint positions
    # are _closed plus the width times _per_width.
    _weights: Tensor = field(init=False, repr=False, compare=False)
    _offset: float = field(init=False, repr=False, compare=False)
    _per_width: Tensor = field(init=False, repr=False, compare=False)
    _closed: Tensor = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name in ("closed", "opened"):
            for position in getattr(self, name):
                check_finite(**{name: position})
        check_above_zero(width=self.width, scale=self.scale)
        double = torch.float64
        closed = torch.tensor(self.closed, dtype=double, device="cpu")
        opened = torch.tensor(self.opened, dtype=double, device="cpu")
        if closed.shape != opened.shape or not (closed != opened).any():
            raise ValueError(
                "closed and opened must have the same length and differ in at least "
                f"one position, got {self.closed} and {self.opened}"
            )
        per_width = (opened - closed) / self.width
        indices = range(len(closed))
        mimics = [joint in self.mimic_joints for joint in indices]
        leads = (closed != opened) & ~torch.tensor(mimics, device="cpu")
        if not leads.any() or not {*self.mimic_joints} <= {*indices}:
            raise ValueError(
                f"mimic_joints must be indices below {len(leads)} and leave out one "
                f"joint that moves, got {self.mimic_joints}"
            )
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
        """Distance between the fingers [m], (n, 1), for joints (n, num_joints)."""
        return (joints * self._weights).sum(dim=1, keepdim=True) + self._offset

    def setpoint(self, action: Tensor, joints: Tensor) -> Tensor:
        """Setpoints of the joints for actions.

        Args:
            action: Clipped actions, (n, 1) float32 in [-1, 1].
            joints: Present positions of the joints, (n, num_joints) float64.

        Returns:
            Positions of the joints, (n, num_joints) float64.
        """
        width = self.fingers_width(joints)
        # The sum is float32, as in panda-gym under NumPy 2.
        target = width.float() + action * self.scale
        setpoint = self._closed + target.double() * self._per_width
        if self.mimic_joints:
            mimic_joints = list(self.mimic_joints)
            setpoint[:, mimic_joints] = (self._closed + width * self._per_width)[
                :, mimic_joints
            ]
        return setpoint
