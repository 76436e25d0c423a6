"""The scripted expert for Flip: taps, drops and swings, planned from the quaternion.

The hand cannot turn, so it turns the cube in two other ways. A tap: with the fingers
open around it, one of them knocks a corner, and the cube spins about z until the
fingers close. A swing: held beside its centre in a grasp that loosens, the cube swings
about y, the axis from finger to finger. A swing that ends with the cube hanging down
can be set down: another face is up then. Last comes a swing that is held where it is
best, or nothing more.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torch_panda.experts.cube_orientations import best_pitch, compose, straighten, turn
from torch_panda.experts.moves import GAIN, norm, open_to
from torch_panda.rotations import rotation_distance as distance

# Widths of the fingers [m]: around the cube, closing on it, holding it as firmly as it
# takes, and where it begins to slip; by what action they loosen and then stay so.
WIDE, CLOSE, HOLD, SLIP = 0.078, 0.02, 0.036, 0.0395
CATCH = 0.034  # while it swings: closing faster would squeeze it out
LOOSEN, STAY = 0.0012, -0.001
ASIDE = 0.014  # [m] beside the cube's centre, so that its weight turns it
LAG = 0.004  # [m] by which the arm's first step upwards takes the grasp towards -x
CLEAR, LIFTED = 0.035, 0.075  # [m], heights from which the grasp loosens, of the swing
LOST = 0.025  # [m] below the fingers, where they hold the cube only just
TILT = 0.15  # [rad] of a cube that need not be straightened before it is swung
TAP_ASIDE = 0.025  # [m] beside the cube's centre, where a finger knocks its corner
SUCCESS, DONE = 0.2, 0.17  # distances: the task's, and one to leave alone
# Costs of a plan: of each quarter turn about y and z, of the last swing, and of the
# distance that it leaves, above all of what exceeds `GOOD`; 1 if it cannot succeed.
PITCH_COST, YAW_COST, SWING_COST, LEFT_COST, MISS_COST = 0.3, 0.15, 0.1, 0.2, 6.0
GOOD, GOOD_LYING = 0.15, 0.13
# Quarter turns about y, then about z: how many (16, 2), as quaternions (16, 4), costs.
QUARTERS = torch.cartesian_prod(*[torch.tensor((0.0, 1.0, -1.0, 2.0))] * 2)
TURNS = compose(
    *(turn(axis, QUARTERS[:, k : k + 1] * math.pi / 2) for axis, k in ((2, 1), (1, 0)))
)
TURN_COSTS = QUARTERS.abs() @ torch.tensor(((PITCH_COST,), (YAW_COST,)))


class Table(NamedTuple):
    """How a cube spins on a table.

    Attributes:
        deceleration: of its spin after a tap [rad/s^2].
        quarter: the action of a tap after which it turns by about a quarter.
        half: by about a half.
    """

    deceleration: float
    quarter: float
    half: float


SLIPPERY = Table(deceleration=15.0, quarter=0.3, half=0.335)  # friction 0.1, of -v1
ROUGH = Table(deceleration=60.0, quarter=0.45, half=0.6)  # 0.5, of -v3


class Plan(NamedTuple):
    """What to do with a cube, each (..., 1) but ``lying``.

    Attributes:
        lying: the straight orientation in which it lies, or will, (..., 4).
        pitch: quarter turns about y that come first, each set down again.
        yaw: quarter turns about z that follow.
        swing: whether a swing comes last.
        stops: whether it lies so when it has stopped spinning, not on the way.
    """

    lying: Tensor
    pitch: Tensor
    yaw: Tensor
    swing: Tensor
    stops: Tensor


def make_plan(cube: Tensor, spin: Tensor, goal: Tensor, table: Table) -> Plan:
    """The plan that comes close to a goal with little effort.

    Args:
        cube: its quaternion, (..., 4).
        spin: of a cube that slides on the table, about z [rad/s], (..., 1).
        goal: the quaternion wanted, (..., 4).
        table: on which it spins.
    """
    # It may be caught now, on the way, or when it will have stopped: (..., 3, 4).
    ahead = (spin * spin.abs() / (2 * table.deceleration)).clamp(-2.0, 2.0)
    ahead = ahead[..., None, :] * ahead.new_tensor(((0.0,), (0.5,), (1.0,)))
    lying = straighten(compose(turn(2, ahead), cube[..., None, :]))
    # Then turned by quarters, and left so or swung: (..., 3, 16, 2).
    turned = compose(TURNS.to(cube), lying[..., None, :])
    goal = goal[..., None, None, :]
    left = torch.cat((distance(turned, goal), best_pitch(turned, goal)[0]), -1)
    miss = (left - left.new_tensor((GOOD_LYING, GOOD))).clamp(min=0.0)
    costs = MISS_COST * miss + LEFT_COST * left + TURN_COSTS.to(cube)
    costs = costs + left.new_tensor((0.0, SWING_COST)) + (left > SUCCESS)
    best = costs.flatten(-3).argmin(-1, keepdim=True)
    caught, turns, swing = best // 32, best // 2 % 16, best % 2 == 1
    lying = lying.take_along_dim(caught[..., None], -2).squeeze(-2)
    pitch, yaw = QUARTERS.to(cube)[turns.squeeze(-1)].split(1, -1)
    return Plan(lying, pitch, yaw, swing, caught == 2)


def descend(ee: Tensor, point: Tensor) -> Tensor:
    """To a point with open fingers, beside which a cube may lie: from above."""
    offset = point - ee
    # Along x the fingers pass the cube on both sides, along y they would hit it.
    off = (offset[..., 1:2].abs() - 0.01).clamp(min=0.0)
    off = off + (offset[..., :1].abs() - 0.03).clamp(min=0.0)
    rise = offset[..., 2:] + (5 * (off - 0.006)).clamp(0.0, 0.06)
    free = (1 - rise / 0.03).clamp(0.0, 1.0)
    # The outstretched arm covers a small part only of an offset along x.
    far = 1 + 30 * (ee[..., :1] - 0.03).clamp(min=0.0)
    return GAIN * torch.cat(
        (offset[..., :1] * far * free, offset[..., 1:2] * free, rise), -1
    )


def tap(
    ee: Tensor, width: Tensor, position: Tensor, yaw: Tensor, table: Table
) -> Tensor:
    """Knock a corner of the cube with a finger, towards the middle of the table."""
    x, y, z = position.split(1, -1)
    ahead = torch.where(y > 0, -1.0, 1.0)
    ready = torch.cat((x + yaw.sign() * ahead * TAP_ASIDE, y, 0 * z + 0.02), -1)
    error = ready - ee
    around = (error[..., :1].abs() < 0.005) & (error[..., 1:2].abs() < 0.03)
    around = around & ((error[..., 2:] - 0.002).abs() < 0.012) & (width > 0.07)
    speed = torch.where(yaw.abs() > 1, table.half, table.quarter)
    knock = torch.cat((GAIN * error[..., :1], speed * ahead, GAIN * error[..., 2:]), -1)
    action = torch.where(around, knock, descend(ee, ready))
    return torch.cat((action, open_to(width, WIDE)), -1)


def grasp(
    ee: Tensor,
    width: Tensor,
    position: Tensor,
    velocity: Tensor,
    aside: Tensor,
    ripe: Tensor,
) -> Tensor:
    """Close the fingers ``aside`` of the cube's centre along x, once it is ``ripe``."""
    x, y, z = (position + 0.04 * velocity).split(1, -1)
    point = torch.cat((x + aside, y, z.clamp(0.02, 0.03)), -1)
    error = (point - ee).abs()
    slides = norm(velocity[..., :2]) > 0.05
    near = (error < error.new_tensor((0.008, 0.02, 0.01))).all(-1, True)
    near = near & (slides | (error[..., :1] < 0.006)) & ripe
    fingers = torch.where(near, open_to(width, CLOSE), open_to(width, WIDE))
    return torch.cat((descend(ee, point), fingers), -1)


def swing(
    ee: Tensor,
    width: Tensor,
    offset: Tensor,
    spin: Tensor,
    pitch: Tensor,
    left: Tensor,
    last: Tensor,
) -> Tensor:
    """Lift the cube, let it swing about y and hold it, or set it down again.

    Args:
        ee: end-effector, (..., 3).
        width: of the fingers, (..., 1).
        offset: of the cube from it, (..., 3).
        spin: of the cube [rad/s], (..., 3).
        pitch: the turn about y that is wanted [rad], (..., 1).
        left: distance to the goal, (..., 1).
        last: whether the cube is to be held, not set down, (..., 1).
    """
    height, rate, turning = ee[..., 2:] + offset[..., 2:], spin[..., 1:2], norm(spin)
    zero = torch.zeros_like(width)
    firmly = open_to(width, HOLD + (CATCH - HOLD) * (turning > 0.5))
    slipping = offset[..., 2:] < -LOST
    there = (pitch.abs() < 0.2) | (pitch * (pitch - 0.04 * rate) < 0) | slipping
    there = there | (left < DONE) | (ee[..., 2:] < CLEAR)
    loosely = torch.where(rate.abs() < 1, LOOSEN, STAY)
    loosely = torch.where(width < SLIP, open_to(width, SLIP + 0.0003), loosely)
    lift = GAIN * (LIFTED - ee[..., 2:])
    lift = torch.cat((zero, zero, lift, torch.where(there, firmly, loosely)), -1)

    # Set down: where it should be, or where it hangs and will not swing on.
    hangs = (offset[..., :1].abs() < 0.004) & (offset[..., 2:] < -0.006)
    over = (hangs | slipping) & (turning < 1) & (pitch.abs() > 0.5)
    over = over | ~last & (pitch.abs() < 0.4) & (turning < 3)
    over = over & ~((left < DONE) & (ee[..., 2:] > CLEAR))
    release = torch.where(height < 0.026, 1.0, firmly)
    down = torch.cat((zero, zero, GAIN * (0.019 - height), release), -1)
    return torch.where(over, down, lift)


def act(
    observation: Tensor,
    achieved_goal: Tensor,
    desired_goal: Tensor,
    table: Table = SLIPPERY,
) -> Tensor:
    """Turn the cube by quarters until one more swing, or nothing, is enough."""
    ee, width, position = (observation[..., a:b] for a, b in ((0, 3), (6, 7), (7, 10)))
    velocity, spin = observation[..., 14:17], observation[..., 17:20]
    cube, goal, offset = achieved_goal, desired_goal, position - ee
    left, turning, zero = distance(cube, goal), norm(spin), torch.zeros_like(width)
    on_table = position[..., 2:] < 0.024
    held = (width > 0.03) & (width < 0.05)
    held = held & (offset.abs() < ee.new_tensor((0.03, 0.04, 0.035))).all(-1, True)

    spin_z = spin[..., 2:]
    plan = make_plan(cube, torch.where(on_table & ~held, spin_z, 0.0), goal, table)
    last = plan.swing & (plan.pitch == 0) & (plan.yaw == 0)
    set_down = compose(turn(1, plan.pitch * math.pi / 2), plan.lying)
    _, pitch = best_pitch(cube, torch.where(last, goal, set_down))
    swings = plan.swing | (plan.pitch != 0)
    stays = plan.stops | (spin_z.abs() < 0.5)
    leave = ~swings & (plan.yaw == 0) & stays
    leave = leave | (left < DONE) & (turning < 0.5) & on_table

    # The fingers straighten a cube that they close on at its centre; straight, it is
    # grasped aside. One that spins is caught when it is nearly straight as planned.
    now = straighten(cube)
    tilt = 2 * (cube * now).sum(-1, keepdim=True).abs().clamp(max=1.0).acos()
    slow, straight = spin_z.abs() < 1.5, tilt < TILT
    aside = LAG - ASIDE * pitch.sign()
    aside = torch.where(swings & straight & slow, aside, 0.0)
    ripe = (tilt < 0.25) | (tilt < 0.65) & slow
    ripe = ripe & (distance(plan.lying, now) < 0.05)

    taps = (plan.pitch == 0) & (plan.yaw != 0)
    action = grasp(ee, width, position, velocity, aside, ripe)
    action = torch.where(taps, tap(ee, width, position, plan.yaw, table), action)
    rise = (ee[..., 2:] < 0.12).to(ee.dtype)
    rise = torch.cat((zero, zero, rise, open_to(width, WIDE)), -1)
    action = torch.where(leave, rise, action)

    # Just gripped on the table: crooked, the cube is squeezed at its centre; then the
    # fingers open to grasp it aside.
    fresh = on_table & (offset[..., 2:].abs() < 0.012)
    centred = offset[..., :1].abs() < 0.008
    crooked = fresh & ~straight & centred
    again = fresh & (~straight | swings & centred & (pitch.abs() > 0.2))
    fingers = torch.where(crooked, open_to(width, CLOSE), 1.0)
    stay = torch.cat((zero, zero, zero, fingers), -1)
    swinging = swing(ee, width, offset, spin, pitch, left, last)
    return torch.where(held, torch.where(again, stay, swinging), action)
