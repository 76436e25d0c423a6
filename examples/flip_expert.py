"""The scripted expert for Flip: turns of the cube, planned from its quaternion."""

import math

import torch
from torch import Tensor

from moves import DECELERATION, GAIN, OPEN, norm, open_to, unit

GRASP_ASIDE = 0.014  # [m] beside the cube's centre, so that its weight turns it
CREEP, RELAX = 0.0008, -0.001  # the gripper's action until the cube turns, and then
GOOD = 0.17  # a distance that is worth aiming at; success is 0.2
TIP_GAP, TIP_HEIGHT = 0.048, 0.022  # [m] from the cube's centre, above the table
TIP_SPEED, TIP_LIFT = 0.6, 0.6  # actions along y and z
QUARTER = math.sqrt(0.5)


def compose(first: Tensor, second: Tensor) -> Tensor:
    """The quaternion of turning by ``second``, then by ``first``, xyzw (..., 4)."""
    first, second = torch.broadcast_tensors(first, second)
    a, a_w, b, b_w = first[..., :3], first[..., 3:], second[..., :3], second[..., 3:]
    scalar = a_w * b_w - (a * b).sum(-1, keepdim=True)
    return torch.cat((a_w * b + b_w * a + torch.linalg.cross(a, b), scalar), -1)


def without_yaw(cube: Tensor) -> Tensor:
    """A cube's quaternion once a grasp has turned its sides along x and y, (..., 4)."""
    x, y, z, w = cube.unbind(-1)
    axes = torch.stack(  # what becomes of the axes x, y and z, (..., 3, 3)
        (
            torch.stack((w * w + x * x - y * y - z * z, 2 * (x * y + z * w)), -1),
            torch.stack((2 * (x * y - z * w), w * w - x * x + y * y - z * z), -1),
            torch.stack((2 * (x * z + y * w), 2 * (y * z - x * w)), -1),
        ),
        -2,
    )
    level = norm(axes).argmax(-2, keepdim=True).expand(*axes.shape[:-2], 1, 2)
    side = axes.gather(-2, level).squeeze(-2)
    yaw = torch.atan2(side[..., 1:], side[..., :1])
    yaw = torch.remainder(yaw + math.pi / 4, math.pi / 2) - math.pi / 4
    zero = torch.zeros_like(yaw)
    turn = torch.cat((zero, zero, (-yaw / 2).sin(), (yaw / 2).cos()), -1)
    return compose(turn, cube)


def best_pitch(cube: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
    """The distance left after the best turn about y, and that turn [rad], (..., 1)."""
    half_turn = compose(cube.new_tensor((0.0, 1.0, 0.0, 0.0)), cube)
    cosine = (goal * cube).sum(-1, keepdim=True)
    sine = (goal * half_turn).sum(-1, keepdim=True)
    angle = 2 * torch.atan2(sine, cosine)
    angle = torch.remainder(angle + math.pi, 2 * math.pi) - math.pi
    return 1 - cosine.square() - sine.square(), angle


def beside(ee: Tensor, point: Tensor) -> Tensor:
    """To a point from above, when y is right: the error along x may remain."""
    offset = point - ee
    error = offset[..., 1:2].abs() + (offset[..., :1].abs() - 0.03).clamp(min=0.0)
    height = (5 * (error - 0.006)).clamp(0.0, 0.06)
    rise = offset[..., 2:] + height
    free = (1 - rise / 0.03).clamp(0.0, 1.0)
    return GAIN * torch.cat((offset[..., :2] * free, rise), -1)


def flip(observation: Tensor, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
    """Turn the cube about x with a stroke of the fingers, about y within the grasp.

    A stroke along y and upwards tips the cube over by a quarter turn about x. Held
    beside its centre in a grasp that loosens, the cube swings about y, the axis from
    finger to finger, until the fingers close. A swing ends when the cube hangs down;
    it is then dropped and grasped again.
    """
    ee, ee_velocity = observation[..., :3], observation[..., 3:6]
    width, cube = observation[..., 6:7], observation[..., 7:10]
    velocity, spin = observation[..., 14:16], observation[..., 17:20]
    goal, offset = desired_goal, cube - ee
    speed, turning, one = norm(velocity), norm(spin), torch.ones_like(width)
    zero = torch.zeros_like(width)
    rest = cube[..., :2] + velocity * speed / (2 * DECELERATION)
    rest = torch.cat((rest, cube[..., 2:]), -1)  # where it will have stopped
    distance = 1 - (achieved_goal * goal).sum(-1, keepdim=True).square()
    tumbling = (turning > 3) | (cube[..., 2:] > 0.025)
    still = (speed < 0.05) & (turning < 0.5)

    # Plan: after one or two strokes along +y or -y, how good would a swing be?
    flat = without_yaw(achieved_goal)
    left, pitch = best_pitch(flat, goal)
    costs = []
    for way in (1.0, -1.0):
        stroke = goal.new_tensor((-way * QUARTER, 0.0, 0.0, QUARTER))
        once = compose(stroke, flat)
        detour = (ee[..., 1:2] - rest[..., 1:2] + 0.05 * way).abs()
        for strokes, turned in ((1, once), (2, compose(stroke, once))):
            reach_y = rest[..., 1:2] + 0.1 * way * strokes
            outside = (reach_y.abs() - 0.2).clamp(min=0.0)
            cost = best_pitch(turned, goal)[0].clamp(min=GOOD)
            costs.append(cost + outside + 0.3 * detour + 0.04 * (strokes - 1))
    forth, back = torch.minimum(*costs[:2]), torch.minimum(*costs[2:])
    side = torch.where(forth < back, one, -one)
    swing = (left < GOOD) | (left + 0.04 < torch.minimum(forth, back))

    # Stroke, with closed fingers: get beside the cube, strike, go on while it tips.
    ready = torch.cat(
        (rest[..., :1], rest[..., 1:2] - side * TIP_GAP, TIP_HEIGHT * one), -1
    )
    closed = width < 0.02
    set_up = (norm(ready - ee) < 0.003) & (norm(ee_velocity) < 0.1) & still & closed
    upward = (ee[..., 2:] < 0.06) & (ee_velocity[..., 2:] > 0.05)
    upward = upward & (ee_velocity[..., 1:2].abs() > 0.2)
    follow = ~still & closed & upward & (norm(offset[..., :2]) < 0.08)
    # The arm's first step upwards takes it back by some millimetres, hence along x.
    strike = torch.cat((0.1 * one, side * TIP_SPEED, TIP_LIFT * one), -1)
    along = torch.cat((unit(velocity) * TIP_SPEED, TIP_LIFT * one), -1)
    stroke = torch.where(set_up, strike, beside(ee, ready))
    stroke = torch.cat((torch.where(follow, along, stroke), -one), -1)

    # Grasp beside the centre, lift, loosen until it swings, close when it is there.
    grip = rest - torch.cat((GRASP_ASIDE * pitch.sign(), zero, zero), -1)
    error = grip - ee
    near = (norm(error[..., :2]) < 0.006) & (error[..., 2:].abs() < 0.008)
    close = torch.where(near, -1.0, open_to(width, OPEN))
    grasp = torch.cat((beside(ee, grip), close), -1)
    _, pitch = best_pitch(achieved_goal, goal)
    rate = spin[..., 1:2]
    there = (pitch.abs() < 0.2) | (pitch * (pitch - 0.04 * rate) < 0)
    there = there | (distance < GOOD) | (offset[..., 2:] < -0.03)
    hanging = (offset[..., :1].abs() < 0.004) & (offset[..., 2:] < -0.006)
    drop = hanging & (turning < 1) & (distance > 0.2) & (pitch.abs() > 0.5)
    loosen = torch.where(rate.abs() < 1, CREEP * one, RELAX * one)
    fingers = torch.where(there | (ee[..., 2:] < 0.055), -one, loosen)
    lift = torch.cat((zero, zero, GAIN * (0.085 - ee[..., 2:])), -1)
    swinging = torch.cat((lift, torch.where(drop, one, fingers)), -1)

    held = (width > 0.03) & (width < 0.05)
    held = held & (offset.abs() < ee.new_tensor((0.03, 0.04, 0.035))).all(-1, True)
    up = (ee[..., 2:] < 0.09).to(ee.dtype)
    rise = torch.cat((zero, zero, up, torch.where(closed, -one, one)), -1)
    action = torch.where(swing, grasp, stroke)
    action = torch.where(tumbling & ~near | still & (distance < 0.19), rise, action)
    action = torch.where(follow, stroke, action)
    return torch.where(held, swinging, action)
