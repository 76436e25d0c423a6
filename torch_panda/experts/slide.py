"""The scripted expert for Slide: one strike, as strong as a fitted polynomial says."""

from collections.abc import Iterable
from math import prod

import torch
from torch import Tensor

from torch_panda.experts.moves import go_over, norm, unit

# How far the closed fingers reach along x and y from the end-effector, and the puck [m]
FINGERS_X, FINGERS_Y, PUCK_RADIUS = 0.008, 0.0217, 0.029
STRIKE_GAP = 0.014  # [m] between fingers and puck before the strike
STRIKE_HEIGHT = 0.02  # [m] of the end-effector
# How strong a strike must be, and by how much the puck then leaves its direction [rad]:
# polynomials in s, the root of the distance; x and y, the puck's place; n, the sine of
# the direction ("sxn" is their product, "" is 1). Fits by fit_strike.py to strikes of
# random strength: of others 90 % stop within 5 cm along the direction, 99 % across it.
# The terms are those that a full cubic, of 35, could not spare.
STRENGTH = {
    "": 0.3047, "s": 0.5741, "x": 0.8988, "ss": 0.2025, "sn": -0.1505, "xn": -2.9521,
    "yn": 0.6878, "sxx": 7.388, "sxn": 3.4006, "xxx": 22.7439,
}  # fmt: skip
DEVIATION = {
    "": -0.0092, "xx": 1.5458, "xy": -4.1378, "xn": 3.2703, "yy": 1.8564,
    "yn": -2.3399, "nn": 0.4009, "xyn": 8.9578, "xnn": -3.859, "ynn": 3.1839,
}  # fmt: skip
OVERSHOOT = 0.006  # [m], of such strikes at the median


def strike_terms(
    terms: Iterable[str], puck: Tensor, distance: Tensor, aim: Tensor, side: Tensor
) -> Tensor:
    """Terms of a polynomial for strikes, mirrored so that they go to the left.

    Args:
        terms: the variables of each, see `STRENGTH`.
        puck: its position, (..., 3).
        distance: how far it should slide [m], (..., 1).
        aim: the direction of the strike, (..., 2).
        side: 1 to the left and -1 to the right, (..., 1).

    Returns:
        (..., terms).
    """
    values = {
        "s": distance.sqrt(),
        "x": puck[..., :1],
        "y": puck[..., 1:2] * side,
        "n": aim[..., 1:] * side,
    }
    one = torch.ones_like(side)
    return torch.cat([prod((values[v] for v in term), start=one) for term in terms], -1)


def strike(
    observation: Tensor, puck: Tensor, aim: Tensor, side: Tensor, strength: Tensor
) -> tuple[Tensor, Tensor]:
    """The action that prepares a strike or does it, and whether it does, (..., 1).

    A corner of the closed fingers strikes along ``aim``, from rest: then the speed at
    which it meets the puck is always the same. For the others see `strike_terms`.
    """
    ee, ee_velocity = observation[..., :3], observation[..., 3:6]
    corner = torch.cat((FINGERS_X + 0 * side, FINGERS_Y * side), -1)
    behind = puck[..., :2] - corner - (PUCK_RADIUS + STRIKE_GAP) * aim
    ready = torch.cat((behind, torch.full_like(side, STRIKE_HEIGHT)), -1)
    set_up = (norm(ready - ee) < 0.001) & (norm(ee_velocity) < 0.05)
    hit = torch.cat((aim * strength, (ready - ee)[..., 2:] / 0.05), -1)
    action = torch.where(set_up, hit, go_over(ee, ready, 0.05))
    moving = norm(observation[..., 12:14]) > 0.05
    return torch.where(moving, 0.0, action), set_up & ~moving


def act(observation: Tensor, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
    """Strike the puck once, with a corner of the fingers, so that it stops there.

    The puck leaves along the line from the corner to its centre, or nearly so.
    """
    puck, offset = achieved_goal, (desired_goal - achieved_goal)[..., :2]
    direction = unit(offset)
    distance = (norm(offset) - OVERSHOOT).clamp(min=0.01)
    side = torch.where(direction[..., 1:] < 0, -1.0, 1.0)
    left = torch.cat((-direction[..., 1:], direction[..., :1]), -1)

    def evaluate(polynomial: dict[str, float], aim: Tensor) -> Tensor:
        terms = strike_terms(polynomial, puck, distance, aim, side)
        return (terms * terms.new_tensor([*polynomial.values()])).sum(-1, keepdim=True)

    aim = direction
    for _ in range(3):  # until the puck, leaving its aim, goes to the goal
        aim = unit(direction - evaluate(DEVIATION, aim) * side * left)
    return strike(observation, puck, aim, side, evaluate(STRENGTH, aim))[0]
