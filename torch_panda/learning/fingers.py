"""Finger actions on the scale of cube roots.

A tenth of a millimetre decides how firmly the fingers hold a cube. That is a thousandth
of their action, less than the error of a network. On the scale of cube roots it is a
tenth.
"""

import torch
from torch import Tensor


def to_fine(action: Tensor) -> Tensor:
    """Replace the finger entry of actions (..., n) by its cube root."""
    rest, fingers = action[..., :-1], action[..., -1:]
    return torch.cat((rest, fingers.sign() * fingers.abs() ** (1 / 3)), -1)


def from_fine(action: Tensor) -> Tensor:
    """Undo `to_fine` for actions (..., n)."""
    return torch.cat((action[..., :-1], action[..., -1:] ** 3), -1)
