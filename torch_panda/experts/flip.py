"""The scripted expert for Flip: taps and swings that are planned from the quaternion.

The hand cannot rotate, so it rotates the cube in two other ways.

- A tap. The fingers are open around the cube, and one of them knocks a corner. The cube
  spins about z until the fingers close.
- A swing. The fingers hold the cube beside its centre and loosen the grasp. The cube
  swings about y, the axis from finger to finger. When it hangs down, the hand can put
  it down with another face up.

A plan consists of quarter turns about y (swings) and about z (taps). After these turns,
it may end with a swing that stops at the angle that is closest to the goal.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torch_panda.experts.cube_orientations import best_pitch, compose, straighten, turn
from torch_panda.experts.moves import GAIN, norm, open_to
from torch_panda.rotations import dot
from torch_panda.rotations import rotation_distance as distance

# Distances between the fingers [m]: around the cube, closing on it, holding it firmly,
# and when the cube begins to slip.
WIDE, CLOSE, HOLD, SLIP = 0.078, 0.02, 0.036, 0.0395
CATCH = 0.034  # distance that stops a swing; a smaller one squeezes the cube out [m]
LOOSEN, STAY = 0.0012, -0.001  # actions that loosen the grasp and keep it loose
ASIDE = 0.014  # offset of the grasp from the centre, so that the cube swings [m]
# The arm's first step upwards shifts the grasp by this distance towards -x, so the
# fingers close this much farther towards +x [m].
LAG = 0.004
CLEAR = 0.035  # height of the hand below which the fingers hold firmly [m]
LIFTED = 0.075  # height of the hand during a swing [m]
LOST = 0.025  # distance of the cube below the fingers at which it nearly falls [m]
# A cube is straight if its edges are parallel to the world's axes. Up to this angle
# from the nearest straight orientation [rad], it can swing without being straightened.
TILT = 0.15
TAP_ASIDE = 0.025  # offset from the centre at which a finger knocks a corner [m]
# Rotation distances to the goal at which the task succeeds, and the hand stops.
SUCCESS, DONE = 0.2, 0.17
# The cost of a plan is a sum. Each quarter turn and a last swing adds its own cost, see
# the next three lines. A plan that does not end in success adds 1. All plans add
# REMAINING_COST * d + MISS_COST * max(0, d - limit). Here d is the rotation distance to
# the goal after the plan. The limit is GOOD_WITH_SWING if a swing is the last move, and
# otherwise GOOD_WITHOUT_SWING.
Y_QUARTER_COST = 0.3  # for each quarter turn about y
Z_QUARTER_COST = 0.15  # for each quarter turn about z
SWING_COST = 0.1  # for a swing as the last move
REMAINING_COST, MISS_COST = 0.2, 6.0
GOOD_WITH_SWING, GOOD_WITHOUT_SWING = 0.15, 0.13
# Quarter turns about y and then z: numbers (16, 2), quaternions (16, 4), and costs.
QUARTERS = torch.cartesian_prod(*[torch.tensor((0.0, 1.0, -1.0, 2.0))] * 2)
TURNS = compose(
    turn(2, QUARTERS[:, 1:] * math.pi / 2), turn(1, QUARTERS[:, :1] * math.pi / 2)
)
TURN_COSTS = dot(QUARTERS.abs(), torch.tensor((Y_QUARTER_COST, Z_QUARTER_COST)))


class Table(NamedTuple):
    """How a spinning cube slows down on a table, and how taps spin it.

    Attributes:
        deceleration: Deceleration of the spin after a tap [rad/s^2].
        quarter: Action of a tap that rotates the cube by about 90 degrees.
        half: Action of a tap that rotates the cube by about 180 degrees.
    """

    deceleration: float
    quarter: float
    half: float


SLIPPERY = Table(deceleration=15.0, quarter=0.3, half=0.335)  # friction 0.1, of -v1
ROUGH = Table(deceleration=60.0, quarter=0.45, half=0.6)  # 0.5, of -v3


class Plan(NamedTuple):
    """A plan for a cube.

    Attributes:
        caught: Orientation in which the hand catches the cube, now or during or after
            its spin, rounded to a straight one, (..., 4).
        y_quarters: Quarter turns about y, which come first, (..., 1).
        z_quarters: Quarter turns about z, which follow, (..., 1).
        ends_with_swing: Whether a swing comes last, (..., 1).
        waits_for_rest: Whether the hand waits until the spin ends before it catches the
            cube, (..., 1).
    """

    caught: Tensor
    y_quarters: Tensor
    z_quarters: Tensor
    ends_with_swing: Tensor
    waits_for_rest: Tensor


def make_plan(cube: Tensor, spin: Tensor, goal: Tensor, table: Table) -> Plan:
    """Plan moves that come close to a goal with little effort.

    Args:
        cube: Quaternion of the cube, (..., 4).
        spin: Velocity of the cube's spin about z on the table [rad/s], (..., 1).
        goal: Quaternion of the goal, (..., 4).
        table: Table on which the cube spins.
    """
    # The hand can catch the cube now, halfway through its spin, or after its spin:
    # (..., 3, 4).
    ahead = (spin * spin.abs() / (2 * table.deceleration)).clamp(-2.0, 2.0)
    ahead = ahead[..., None, :] * ahead.new_tensor(((0.0,), (0.5,), (1.0,)))
    caught = straighten(compose(turn(2, ahead), cube[..., None, :]))
    # Quarter turns follow, and then nothing or a swing: (..., 3, 16, 2).
    turned = compose(TURNS.to(cube), caught[..., None, :])
    goal = goal[..., None, None, :]
    remaining = torch.cat((distance(turned, goal), best_pitch(turned, goal)[0]), -1)
    good = remaining.new_tensor((GOOD_WITHOUT_SWING, GOOD_WITH_SWING))
    miss = (remaining - good).clamp(min=0.0)
    costs = MISS_COST * miss + REMAINING_COST * remaining + TURN_COSTS.to(cube)
    costs = costs + remaining.new_tensor((0.0, SWING_COST)) + (remaining > SUCCESS)
    best = costs.flatten(-3).argmin(-1, keepdim=True)
    when, turns, swings = torch.unravel_index(best, (3, 16, 2))
    caught = caught.take_along_dim(when[..., None], -2).squeeze(-2)
    y_quarters, z_quarters = QUARTERS.to(cube)[turns.squeeze(-1)].split(1, -1)
    return Plan(caught, y_quarters, z_quarters, swings == 1, when == 2)


def descend(ee: Tensor, point: Tensor) -> Tensor:
    """Descend to a point at a cube.

    Stay above the cube until the open fingers pass it on both sides.

    Returns:
        The action of the arm, (..., 3).
    """
    offset = point - ee
    # The fingers pass the cube on both sides even if the hand is off by 3 cm along x.
    # If it is off by more than 1.6 cm along y, a finger would hit the cube: stay above.
    off = (offset[..., 1:2].abs() - 0.01).clamp(min=0.0)
    off = off + (offset[..., :1].abs() - 0.03).clamp(min=0.0)
    rise = offset[..., 2:] + (5 * (off - 0.006)).clamp(0.0, 0.06)
    free = (1 - rise / 0.03).clamp(0.0, 1.0)
    # Stretched out, the arm covers only a small part of an offset along x in one step,
    # so enlarge the action along x.
    far = 1 + 30 * (ee[..., :1] - 0.03).clamp(min=0.0)
    return GAIN * torch.cat(
        (offset[..., :1] * far * free, offset[..., 1:2] * free, rise), -1
    )


def tap(
    ee: Tensor, width: Tensor, position: Tensor, z_quarters: Tensor, table: Table
) -> Tensor:
    """Knock a corner of the cube with a finger, towards the middle of the table."""
    x, y, z = position.split(1, -1)
    towards_middle = torch.where(y > 0, -1.0, 1.0)  # sign of the knock along y
    ready = torch.cat(
        (x + z_quarters.sign() * towards_middle * TAP_ASIDE, y, 0 * z + 0.02), -1
    )
    error = ready - ee
    around = (error[..., :1].abs() < 0.005) & (error[..., 1:2].abs() < 0.03)
    around = around & ((error[..., 2:] - 0.002).abs() < 0.012) & (width > 0.07)
    speed = torch.where(z_quarters.abs() > 1, table.half, table.quarter)
    sideways = speed * towards_middle
    knock = torch.cat((GAIN * error[..., :1], sideways, GAIN * error[..., 2:]), -1)
    action = torch.where(around, knock, descend(ee, ready))
    return torch.cat((action, open_to(width, WIDE)), -1)


def grasp(
    ee: Tensor,
    width: Tensor,
    position: Tensor,
    velocity: Tensor,
    aside: Tensor,
    may_close: Tensor,
) -> Tensor:
    """Move the open fingers beside the cube's centre, and close them there.

    Args:
        ee: Position of the end-effector, (..., 3).
        width: Distance between the fingers, (..., 1).
        position: Position of the cube, (..., 3).
        velocity: Velocity of the cube, (..., 3).
        aside: Offset of the grasp from the centre along x [m], (..., 1).
        may_close: Whether the fingers may close, (..., 1) bool.
    """
    x, y, z = (position + 0.04 * velocity).split(1, -1)
    point = torch.cat((x + aside, y, z.clamp(0.02, 0.03)), -1)
    error = (point - ee).abs()
    is_sliding = norm(velocity[..., :2]) > 0.05
    near = (error < error.new_tensor((0.008, 0.02, 0.01))).all(-1, True)
    near = near & (is_sliding | (error[..., :1] < 0.006)) & may_close
    fingers = torch.where(near, open_to(width, CLOSE), open_to(width, WIDE))
    return torch.cat((descend(ee, point), fingers), -1)


def swing(
    ee: Tensor,
    width: Tensor,
    offset: Tensor,
    spin: Tensor,
    pitch: Tensor,
    remaining: Tensor,
    last: Tensor,
) -> Tensor:
    """Lift the cube, let it swing about y, and then hold it or set it down.

    Args:
        ee: Position of the end-effector, (..., 3).
        width: Distance between the fingers, (..., 1).
        offset: Offset of the cube from the end-effector, (..., 3).
        spin: Angular velocity of the cube [rad/s], (..., 3).
        pitch: Remaining rotation about y [rad], (..., 1).
        remaining: Rotation distance to the goal, (..., 1).
        last: Whether to hold the cube after the swing, and not set it down, (..., 1).
    """
    cube_height = ee[..., 2:] + offset[..., 2:]
    rate, turning = spin[..., 1:2], norm(spin)
    zero = torch.zeros_like(width)
    firmly = open_to(width, HOLD + (CATCH - HOLD) * (turning > 0.5))
    slipping = offset[..., 2:] < -LOST
    arrived = (pitch.abs() < 0.2) | (pitch * (pitch - 0.04 * rate) < 0) | slipping
    arrived = arrived | (remaining < DONE) | (ee[..., 2:] < CLEAR)
    loosely = torch.where(rate.abs() < 1, LOOSEN, STAY)
    loosely = torch.where(width < SLIP, open_to(width, SLIP + 0.0003), loosely)
    lift = GAIN * (LIFTED - ee[..., 2:])
    lift = torch.cat((zero, zero, lift, torch.where(arrived, firmly, loosely)), -1)

    # Set the cube down if it has the wanted face up, hangs without swinging, or nearly
    # falls.
    hangs = (offset[..., :1].abs() < 0.004) & (offset[..., 2:] < -0.006)
    set_down = (hangs | slipping) & (turning < 1) & (pitch.abs() > 0.5)
    set_down = set_down | ~last & (pitch.abs() < 0.4) & (turning < 3)
    set_down = set_down & ~((remaining < DONE) & (ee[..., 2:] > CLEAR))
    release = torch.where(cube_height < 0.026, 1.0, firmly)
    down = torch.cat((zero, zero, GAIN * (0.019 - cube_height), release), -1)
    return torch.where(set_down, down, lift)


def act(
    observation: Tensor,
    achieved_goal: Tensor,
    desired_goal: Tensor,
    table: Table = SLIPPERY,
) -> Tensor:
    """Rotate the cube by quarters, and then swing it if that is not enough."""
    ee, width, position = (observation[..., a:b] for a, b in ((0, 3), (6, 7), (7, 10)))
    velocity, spin = observation[..., 14:17], observation[..., 17:20]
    cube, goal, offset = achieved_goal, desired_goal, position - ee
    remaining, turning, zero = distance(cube, goal), norm(spin), torch.zeros_like(width)
    on_table = position[..., 2:] < 0.024
    held = (width > 0.03) & (width < 0.05)
    held = held & (offset.abs() < ee.new_tensor((0.03, 0.04, 0.035))).all(-1, True)

    spin_z = spin[..., 2:]
    plan = make_plan(cube, torch.where(on_table & ~held, spin_z, 0.0), goal, table)
    last = plan.ends_with_swing & (plan.y_quarters == 0) & (plan.z_quarters == 0)
    turned = compose(turn(1, plan.y_quarters * math.pi / 2), plan.caught)
    _, pitch = best_pitch(cube, torch.where(last, goal, turned))
    needs_swing = plan.ends_with_swing | (plan.y_quarters != 0)
    comes_to_rest = plan.waits_for_rest | (spin_z.abs() < 0.5)
    needs_nothing = ~needs_swing & (plan.z_quarters == 0) & comes_to_rest
    needs_nothing = needs_nothing | (remaining < DONE) & (turning < 0.5) & on_table

    # Fingers that close on the centre straighten the cube. A straight cube that has to
    # swing is grasped beside its centre. A spinning cube is caught when it is nearly
    # straight.
    now = straighten(cube)
    tilt = 2 * dot(cube, now).abs().clamp(max=1.0).double().acos().to(cube)
    slow, straight = spin_z.abs() < 1.5, tilt < TILT
    aside = LAG - ASIDE * pitch.sign()
    aside = torch.where(needs_swing & straight & slow, aside, 0.0)
    may_close = (tilt < 0.25) | (tilt < 0.65) & slow
    may_close = may_close & (distance(plan.caught, now) < 0.05)

    needs_tap = (plan.y_quarters == 0) & (plan.z_quarters != 0)
    action = grasp(ee, width, position, velocity, aside, may_close)
    action = torch.where(
        needs_tap, tap(ee, width, position, plan.z_quarters, table), action
    )
    rise = (ee[..., 2:] < 0.12).to(ee.dtype)
    rise = torch.cat((zero, zero, rise, open_to(width, WIDE)), -1)
    action = torch.where(needs_nothing, rise, action)

    # On the table, squeeze a crooked cube at its centre. Then open the fingers to grasp
    # it beside its centre.
    just_grasped = on_table & (offset[..., 2:].abs() < 0.012)
    centred = offset[..., :1].abs() < 0.008
    crooked = just_grasped & ~straight & centred
    regrasp = just_grasped & (~straight | needs_swing & centred & (pitch.abs() > 0.2))
    fingers = torch.where(crooked, open_to(width, CLOSE), 1.0)
    stay = torch.cat((zero, zero, zero, fingers), -1)
    swinging = swing(ee, width, offset, spin, pitch, remaining, last)
    return torch.where(held, torch.where(regrasp, stay, swinging), action)
