"""The scripted expert for Slide: one strike, whose strength is a fitted polynomial."""

from math import prod

import torch
from torch import Tensor

from torch_panda.experts.moves import go_over, norm, sqrt, unit
from torch_panda.rotations import dot
from torch_panda.tasks.slide import PUCK_RADIUS

# How far the closed fingers extend from the end-effector along x and along y [m].
FINGERS_X, FINGERS_Y = 0.008, 0.0217
STRIKE_GAP = 0.013  # distance between fingers and puck before the strike [m]
STRIKE_HEIGHT = 0.02  # height of the end-effector in the strike [m]
# Two polynomials describe a strike. STRENGTH is the action that sends the puck to a
# distance. DEVIATION is the angle between the strike and the puck's path [rad]. Their
# variables are s, the root of the distance; x and y, the puck's position; and n, the
# sine of the direction. The keys are terms: "sxn" stands for s * x * n, and "" for 1.
# The coefficients were fitted to random strikes in PandaSlide-v1 (by fit_strike.py of
# commit 0ac2f60) and tested on others: 90 % of the pucks stop within 5 cm of the
# predicted distance, and 99 % within 5 cm sideways. Cubic terms that do not improve the
# fit are left out.
STRENGTH = {
    "": 0.3047, "s": 0.5741, "x": 0.8988, "ss": 0.2025, "sn": -0.1505, "xn": -2.9521,
    "yn": 0.6878, "sxx": 7.388, "sxn": 3.4006, "xxx": 22.7439,
}  # fmt: skip
DEVIATION = {
    "": -0.0092, "xx": 1.5458, "xy": -4.1378, "xn": 3.2703, "yy": 1.8564,
    "yn": -2.3399, "nn": 0.4009, "xyn": 8.9578, "xnn": -3.859, "ynn": 3.1839,
}  # fmt: skip
OVERSHOOT = 0.006  # median distance by which these strikes go too far [m]


def act(observation: Tensor, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
    """Strike the puck once so that it stops at the goal, with a corner of the hand.

    The hand starts from rest at a fixed distance behind the puck, so the speed at the
    puck depends on the strength of the action alone. While the puck moves, the action
    is 0.
    """
    puck, offset = achieved_goal, (desired_goal - achieved_goal)[..., :2]
    direction = unit(offset)
    distance = (norm(offset) - OVERSHOOT).clamp(min=0.01)
    # 1 for a strike to the left, and -1 for a strike to the right, for which the
    # polynomials get the values of the mirrored strike.
    side = torch.where(direction[..., 1:] < 0, -1.0, 1.0)
    left = torch.cat((-direction[..., 1:], direction[..., :1]), -1)

    def evaluate(polynomial: dict[str, float], aim: Tensor) -> Tensor:
        values = {
            "s": sqrt(distance),
            "x": puck[..., :1],
            "y": puck[..., 1:2] * side,
            "n": aim[..., 1:] * side,
        }
        one = torch.ones_like(side)
        terms = torch.cat(
            [prod((values[v] for v in term), start=one) for term in polynomial], -1
        )
        return dot(terms, terms.new_tensor([*polynomial.values()]))

    aim = direction
    for _ in range(3):  # a fixed-point iteration: aim against the deviation
        aim = unit(direction - evaluate(DEVIATION, aim) * side * left)

    ee, ee_velocity = observation[..., :3], observation[..., 3:6]
    corner = torch.cat((FINGERS_X + 0 * side, FINGERS_Y * side), -1)
    behind = puck[..., :2] - corner - (PUCK_RADIUS + STRIKE_GAP) * aim
    ready = torch.cat((behind, torch.full_like(side, STRIKE_HEIGHT)), -1)
    set_up = (norm(ready - ee) < 0.001) & (norm(ee_velocity) < 0.05)
    strike = torch.cat(
        (aim * evaluate(STRENGTH, aim), (ready - ee)[..., 2:] / 0.05), -1
    )
    action = torch.where(set_up, strike, go_over(ee, ready, 0.05))
    is_moving = norm(observation[..., 12:14]) > 0.05
    return torch.where(is_moving, 0.0, action)
