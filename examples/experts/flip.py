"""The scripted expert for Flip: turns of the cube, planned from its quaternion."""

import math

import torch
from torch import Tensor

from experts.moves import CUBE, GAIN, OPEN, ROUGH, norm, open_to, unit

GRASP_ASIDE = 0.014  # [m] beside the cube's centre, so that its weight turns it
CREEP, RELAX = 0.0012, -0.001  # the gripper's action until the cube turns, and then
FREE, HUNG = 0.035, 0.1  # [m], heights from which the grasp loosens, and of the swing
GOOD = 0.17  # a distance that is worth aiming at; success is 0.2
# Strokes along y, where the fingers are wide, and along x: from where [m from the
# cube's centre, m above the table], and actions along the stroke and upwards.
GAP_Y, HEIGHT_Y, SPEED_Y, LIFT_Y = 0.051, 0.022, 0.6, 0.6
GAP_X, HEIGHT_X, SPEED_X, LIFT_X = 0.035, 0.024, 0.75, 0.6
WAYS = ((0.0, 1.0), (0.0, -1.0), (1.0, 0.0))  # of strokes; towards -x they fail
STROKE_COST, SWING_COST, DETOUR_COST = 0.04, 0.06, 0.2  # the last one per metre
QUARTER = math.sqrt(0.5)


def compose(first: Tensor, second: Tensor) -> Tensor:
    """The quaternion of turning by ``second``, then by ``first``, xyzw (..., 4)."""
    first, second = torch.broadcast_tensors(first, second)
    a, a_w, b, b_w = first[..., :3], first[..., 3:], second[..., :3], second[..., 3:]
    scalar = a_w * b_w - (a * b).sum(-1, keepdim=True)
    return torch.cat((a_w * b + b_w * a + torch.linalg.cross(a, b), scalar), -1)


def yaw_of(cube: Tensor) -> Tensor:
    """How far a cube's sides are turned from x and y, within 45 degrees, (..., 1)."""
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
    return torch.remainder(yaw + math.pi / 4, math.pi / 2) - math.pi / 4


def without(yaw: Tensor, cube: Tensor) -> Tensor:
    """A cube's quaternion turned back by a yaw [rad], as a grasp does, (..., 4)."""
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


def costs(cube: Tensor, flat: Tensor, goal: Tensor, strokes: int) -> Tensor:
    """What it costs to reach a goal from a cube that lies still, (..., ways + 2).

    Args:
        cube: its quaternion, (..., 4).
        flat: the same without yaw, as a grasp would turn it.
        goal: the quaternion wanted.
        strokes: how many may be planned.

    Returns:
        of leaving it, of a swing, and of beginning with a stroke of each way.
    """

    def miss(distance: Tensor) -> Tensor:
        return 4 * (distance - GOOD).clamp(min=0.0)

    lying = 1 - (cube * goal).sum(-1, keepdim=True).square()
    found = [miss(lying), miss(best_pitch(flat, goal)[0]) + SWING_COST]
    for x, y in WAYS if strokes else ():
        turn = goal.new_tensor((-y * QUARTER, x * QUARTER, 0.0, QUARTER))
        after = compose(turn, cube), compose(turn, flat)
        least = costs(*after, goal, strokes - 1).amin(-1, keepdim=True)
        found.append(STROKE_COST + least)
    return torch.cat(found, -1)


def descend(ee: Tensor, point: Tensor, error: Tensor) -> Tensor:
    """To a point from above, the lower the smaller the error [m], (..., 1)."""
    offset = point - ee
    rise = offset[..., 2:] + (5 * (error - 0.006)).clamp(0.0, 0.06)
    free = (1 - rise / 0.03).clamp(0.0, 1.0)
    # The outstretched arm covers a small part only of an offset along x.
    far = 1 + 30 * (ee[..., :1] - 0.1).clamp(min=0.0)
    return GAIN * torch.cat(
        (offset[..., :1] * far * free, offset[..., 1:2] * free, rise), -1
    )


def act(observation: Tensor, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
    """Turn the cube with strokes of the fingers, or about y within the grasp.

    A stroke upwards along +x, +y or -y tips the cube over by a quarter turn. Held
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
    rest = cube[..., :2] + velocity * speed / (2 * ROUGH)
    rest = torch.cat((rest, cube[..., 2:]), -1)  # where it will have stopped
    distance = 1 - (achieved_goal * goal).sum(-1, keepdim=True).square()
    tumbling = (turning > 3) | (cube[..., 2:] > 0.025)
    still = (speed < 0.05) & (turning < 0.5)

    # Plan: a swing, or at most two strokes before it, not out of reach.
    yaw = yaw_of(achieved_goal)
    flat = without(yaw, achieved_goal)
    _, pitch = best_pitch(flat, goal)
    plan = costs(achieved_goal, flat, goal, strokes=2)[..., 1:]
    ways = goal.new_tensor(WAYS)
    ends = rest[..., None, :2] + 0.1 * ways
    outside = (ends.abs() - 0.2).clamp(min=0.0).sum(-1)
    starts = rest[..., None, :2] - 0.05 * ways
    detour = norm(ee[..., None, :2] - starts).squeeze(-1)
    extra = torch.cat((zero, outside + DETOUR_COST * detour), -1)
    choice = (plan + extra).argmin(-1)
    swing = choice.unsqueeze(-1) == 0
    way = ways[(choice - 1).clamp(min=0)]

    # Stroke, with closed fingers: get beside the cube, strike, go on while it tips.
    numbers = goal.new_tensor(
        ((GAP_Y, HEIGHT_Y, SPEED_Y, LIFT_Y), (GAP_X, HEIGHT_X, SPEED_X, LIFT_X))
    )
    gap, height, pace, lift = numbers[way[..., 0].long()].split(1, -1)
    # A corner sticks out.
    gap = gap + CUBE / 2 * (yaw.abs().cos() + yaw.abs().sin() - 1)
    ready = torch.cat((rest[..., :2] - gap * way, height), -1)
    closed = width < 0.02
    set_up = (norm(ready - ee) < 0.003) & (norm(ee_velocity) < 0.2) & still & closed
    upward = (ee[..., 2:] < 0.06) & (ee_velocity[..., 2:] > 0.05)
    upward = upward & (norm(ee_velocity[..., :2]) > 0.2)
    follow = ~still & closed & upward & (norm(offset[..., :2]) < 0.08)
    # The arm's first step upwards takes it back by some millimetres, hence along x.
    back = 0.1 * way[..., 1:].abs()
    strike = torch.cat((pace * way[..., :1] + back, pace * way[..., 1:], lift), -1)
    along = torch.cat((unit(velocity) * SPEED_Y, LIFT_Y * one), -1)
    ahead = ((ee - ready)[..., :2] * way).sum(-1, keepdim=True)
    stroke = torch.where(set_up, strike, descend(ee, ready, ahead))
    stroke = torch.cat((torch.where(follow, along, stroke), -one), -1)

    # Grasp beside the centre, lift, loosen until it swings, close when it is there.
    grip = rest - torch.cat((GRASP_ASIDE * pitch.sign(), zero, zero), -1)
    error = grip - ee
    aside = error[..., 1:2].abs() + (error[..., :1].abs() - 0.03).clamp(min=0.0)
    near = (norm(error[..., :2]) < 0.006) & (error[..., 2:].abs() < 0.008)
    close = torch.where(near, -1.0, open_to(width, OPEN))
    grasp = torch.cat((descend(ee, grip, aside), close), -1)
    _, pitch = best_pitch(achieved_goal, goal)
    rate = spin[..., 1:2]
    there = (pitch.abs() < 0.2) | (pitch * (pitch - 0.04 * rate) < 0)
    there = there | (distance < GOOD) | (offset[..., 2:] < -0.03)
    hanging = (offset[..., :1].abs() < 0.004) & (offset[..., 2:] < -0.006)
    drop = hanging & (turning < 1) & (distance > 0.2) & (pitch.abs() > 0.5)
    loosen = torch.where(rate.abs() < 1, CREEP * one, RELAX * one)
    fingers = torch.where(there | (ee[..., 2:] < FREE), -one, loosen)
    lift = torch.cat((zero, zero, GAIN * (HUNG - ee[..., 2:])), -1)
    swinging = torch.cat((lift, torch.where(drop, one, fingers)), -1)

    held = (width > 0.03) & (width < 0.05)
    held = held & (offset.abs() < ee.new_tensor((0.03, 0.04, 0.035))).all(-1, True)
    up = (ee[..., 2:] < 0.09).to(ee.dtype)
    rise = torch.cat((zero, zero, up, torch.where(closed, -one, one)), -1)
    action = torch.where(swing, grasp, stroke)
    action = torch.where(tumbling & ~near | still & (distance < 0.19), rise, action)
    action = torch.where(follow, stroke, action)
    return torch.where(held, swinging, action)
