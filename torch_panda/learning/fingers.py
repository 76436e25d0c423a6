"""Cube roots of finger actions, for a finer control of the fingers.

How firmly the fingers hold a cube depends on tenths of a millimetre. Such a distance is
0.001 of the fingers' action, which is less than the error of a network. The cube root
of 0.001 is 0.1, which a network can learn. So networks output cube roots.
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
