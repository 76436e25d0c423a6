"""What the fingers are told, on a scale where small numbers are far apart.

A gripper holds a cube more or less firmly by tenths of a millimetre, thousandths of its
action: less than a network errs by. On the scale of cube roots they are tenths.
"""

import torch
from torch import Tensor


def to_fine(action: Tensor) -> Tensor:
    """The fingers' part of actions on the scale of cube roots, (..., n) both."""
    rest, fingers = action[..., :-1], action[..., -1:]
    return torch.cat((rest, fingers.sign() * fingers.abs() ** (1 / 3)), -1)


def from_fine(action: Tensor) -> Tensor:
    """What the environment is given, (..., n) both."""
    return torch.cat((action[..., :-1], action[..., -1:] ** 3), -1)
