"""Flip's expert: its rotations and its plans."""

import math

import pytest
import torch
from torch.nn.functional import normalize

from torch_panda.experts.cube_orientations import (
    STRAIGHT,
    best_pitch,
    compose,
    straighten,
    turn,
)
from torch_panda.experts.flip import ROUGH, SLIPPERY, make_plan
from torch_panda.rotations import rotation_distance as distance


def orientations(number, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return normalize(torch.randn(number, 4, generator=generator), dim=-1)


def rotate(quaternion, vector):
    """A vector turned by a quaternion: q v q*, (..., 3)."""
    pure = torch.cat((vector, torch.zeros_like(vector[..., :1])), -1)
    conjugate = quaternion * quaternion.new_tensor((-1.0, -1.0, -1.0, 1.0))
    return compose(compose(quaternion, pure), conjugate)[..., :3]


def angles(*values):
    return torch.tensor(values)[:, None]


def test_turns_go_from_x_to_y_about_z():
    quarter = turn(2, angles(math.pi / 2))
    x, y = torch.eye(3)[:2, None]
    torch.testing.assert_close(rotate(quarter, x), y)


def test_compose_turns_by_the_second_first():
    a, b = orientations(50).split(25)
    vector = torch.randn(25, 3, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(
        rotate(compose(a, b), vector), rotate(a, rotate(b, vector))
    )


def test_straight_orientations_are_the_24_that_map_axes_to_axes():
    apart = distance(STRAIGHT[:, None], STRAIGHT[None]).squeeze(-1)
    assert ((apart > 0.1) | torch.eye(24, dtype=torch.bool)).all()
    for axis in torch.eye(3):
        moved = rotate(STRAIGHT, axis.expand(24, 3))
        torch.testing.assert_close(moved, moved.round(), atol=1e-6, rtol=0)


def test_straighten_undoes_a_small_turn():
    tilt = compose(turn(1, angles(0.3)), turn(2, angles(-0.3)))
    assert (distance(straighten(compose(tilt, STRAIGHT)), STRAIGHT) < 1e-6).all()


def test_no_other_pitch_is_better():
    start, goal = orientations(50).split(25)
    left, pitch = best_pitch(start, goal)
    reached = compose(turn(1, pitch), start)
    torch.testing.assert_close(distance(reached, goal), left, atol=1e-6, rtol=0)
    tried = turn(1, torch.linspace(-math.pi, math.pi, 100)[:, None])
    others = distance(compose(tried[:, None], start), goal)
    assert (others > left - 1e-6).all()


STILL = torch.zeros(1, 1)
UPRIGHT = torch.tensor(((0.0, 0.0, 0.0, 1.0),))


def plan_for(goal, spin=STILL, table=SLIPPERY):
    plan = make_plan(UPRIGHT, spin, goal, table)
    return plan.y_quarters.item(), plan.z_quarters.item(), plan.ends_with_swing.item()


def test_a_cube_that_lies_well_is_left_alone():
    assert plan_for(turn(2, angles(0.2))) == (0, 0, False)


@pytest.mark.parametrize("quarters", [1, -1])
def test_a_quarter_about_z_is_a_tap(quarters):
    assert plan_for(turn(2, angles(quarters * math.pi / 2))) == (0, quarters, False)


@pytest.mark.parametrize("angle", [-2.5, -1.0, 1.0, 2.5])
def test_any_turn_about_y_is_a_swing(angle):
    assert plan_for(turn(1, angles(angle))) == (0, 0, True)


def test_plans_lead_to_their_goal():
    """Plans reach 99.7 % of all orientations."""
    goal = orientations(2000)
    caught, pitch, yaw, swing, _ = make_plan(
        UPRIGHT.expand(2000, 4), STILL.expand(2000, 1), goal, SLIPPERY
    )
    turned = compose(turn(1, pitch * math.pi / 2), caught)
    turned = compose(turn(2, yaw * math.pi / 2), turned)
    left = torch.where(swing, best_pitch(turned, goal)[0], distance(turned, goal))
    assert (left < 0.2).double().mean() > 0.99
    assert {0.0, 1.0, -1.0} <= set(pitch.flatten().tolist())
    assert {0.0, 1.0, -1.0, 2.0} == set(yaw.flatten().tolist())


@pytest.mark.parametrize(
    ("table", "spin", "quarters"),
    [(SLIPPERY, 0.0, 1), (SLIPPERY, 7.0, 0), (ROUGH, 7.0, 1), (ROUGH, 14.0, 0)],
)
def test_a_cube_that_will_spin_to_its_goal_needs_no_tap(table, spin, quarters):
    goal = turn(2, angles(math.pi / 2))
    assert plan_for(goal, angles(spin), table)[1] == quarters


@pytest.mark.parametrize(("spin", "waits"), [(5.5, True), (7.0, False)])
def test_a_cube_that_spins_past_its_goal_must_be_caught(spin, waits):
    """A spin of 5.5 rad/s ends after 1.0 rad, near a quarter; 7 rad/s goes past it."""
    plan = make_plan(UPRIGHT, angles(spin), turn(2, angles(math.pi / 2)), SLIPPERY)
    assert (plan.z_quarters.item(), plan.waits_for_rest.item()) == (0, waits)
