"""The scripted expert for Stack."""

import torch
from torch import Tensor

from torch_panda.experts.moves import carry, is_held, norm, push_to
from torch_panda.tasks.table import CUBE_SIZE


def act(observation: Tensor, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
    """Carry the lower cube to its goal, and then the upper cube onto it.

    If the upper cube leaves no room for the fingers beside the lower cube, the hand
    pushes it aside first.
    """
    ee, width = observation[..., :3], observation[..., 6:7]
    lower, upper = achieved_goal.split(3, -1)
    lower_speed, upper_speed = (norm(observation[..., k : k + 3]) for k in (13, 25))
    lower_held, upper_held = is_held(ee, width, lower), is_held(ee, width, upper)
    goal, top = desired_goal[..., :3], lower + lower.new_tensor((0.0, 0.0, CUBE_SIZE))

    def arrived(error: Tensor, speed: Tensor, held: Tensor, tolerance: float) -> Tensor:
        return torch.where(held, (error < 0.01) & (speed < 0.1), error < tolerance)

    placed = arrived(norm(lower - goal), lower_speed, lower_held, 0.025)
    stacked = arrived(norm(upper - top), upper_speed, upper_held, 0.02)
    to_lower, to_upper = norm(ee - lower), norm(ee - upper)
    must_rise = (to_lower < 0.06) & (to_lower < to_upper) & ~upper_held
    must_rise = must_rise | placed & stacked & (ee[..., 2:] < 0.15)
    # Rise only when the fingers are closed or wide open, because fingers that are still
    # opening would lift the cube.
    upwards = torch.where((width < 0.02) | (width > 0.06), 1.0, 0.0)
    rise = torch.cat((0 * ee[..., :2], upwards, 0.4 + 0 * width), -1)
    finish = torch.where(stacked, 0.0, carry(ee, width, upper, top, clearance=0.06))
    finish = torch.where(must_rise, rise, finish)

    # The fingers need room beside the lower cube and beside its goal.
    room = upper.new_tensor((0.045, 0.085))

    def upper_crowds(point: Tensor) -> Tensor:
        return ((upper - point)[..., :2].abs() < room).all(-1, True)

    # Push the upper cube away from the point that it crowds, along x or along y.
    crowded_point = torch.where(upper_crowds(lower) | placed, lower, goal)
    apart = (upper - crowded_point)[..., :2]
    along_x = apart[..., :1].abs() > apart[..., 1:].abs()
    # Aim 3 cm too far, because `push_to` may stop the cube 3 cm before its target.
    sign = torch.where(apart < 0, -1.0, 1.0)
    side = crowded_point[..., :2] + sign * apart.new_tensor((0.1, 0.125))
    moves = torch.cat((along_x, ~along_x), -1)
    aside = torch.where(moves, side, upper[..., :2])
    aside = torch.cat((aside, upper[..., 2:]), -1)
    push_aside = push_to(ee, upper, observation[..., 25:27], aside)
    push_aside = torch.cat((push_aside, 0 * width - 1), -1)
    on_top = upper[..., 2:] > 0.03
    is_holding = lower_held | upper_held
    blocked = upper_crowds(crowded_point) & ~(is_holding | placed & on_top)
    action = torch.where(placed, finish, carry(ee, width, lower, goal))
    action = torch.where(blocked, torch.where(must_rise, rise, push_aside), action)
    # If both cubes are at their goals, do not touch them any more.
    done = torch.maximum(norm(lower - goal), norm(upper - desired_goal[..., 3:])) < 0.03
    hold = torch.cat((0 * ee, torch.where(upper_held, -1.0, 0.0)), -1)
    return torch.where(done, hold, action)
