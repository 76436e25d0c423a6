"""Rotations of Flip's expert."""

import math

import torch
from torch.nn.functional import normalize

from torch_panda.experts.cube_orientations import (
    STRAIGHT,
    best_pitch,
    compose,
    straighten,
    turn,
)
from torch_panda.rotations import rotate
from torch_panda.rotations import rotation_distance as distance


def orientations(number):
    generator = torch.Generator().manual_seed(0)
    return normalize(torch.randn(number, 4, generator=generator), dim=-1)


def angles(*values):
    return torch.tensor(values)[:, None]


def test_turns_go_from_x_to_y_about_z():
    quarter = turn(2, angles(math.pi / 2))
    x, y = torch.eye(3)[:2, None]
    torch.testing.assert_close(rotate(quarter, x), y)


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
