"""The scripted experts for Push: one for the slippery table, one for the rough one."""

import torch
from torch import Tensor

from torch_panda.experts.moves import go_over, norm, push_to
from torch_panda.tasks.table import CUBE_SIZE

ON_TOP = 0.01  # height of the pressing end-effector above the cube's top [m]


def drag(observation: Tensor, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
    """Press on the cube from above and drag it to the goal.

    This is for the slippery table of -v1, on which a pushed cube would slide too far.
    """
    ee, cube = observation[..., :3], achieved_goal
    sideways, top = (cube - ee)[..., :2], cube[..., 2:] + CUBE_SIZE / 2 + ON_TOP
    is_pressing = (norm(sideways) < CUBE_SIZE / 2) & (ee[..., 2:] < top + 0.004)
    step = 0.6 * (desired_goal - cube)[..., :2]
    step = step / (norm(step) / 0.02).clamp(min=1.0)
    drag_action = torch.cat((step, torch.full_like(top, -0.01)), -1) / 0.05
    on_top = torch.cat((cube[..., :2], top - 0.003), -1)
    return torch.where(is_pressing, drag_action, go_over(ee, on_top, 0.04))


def push(observation: Tensor, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
    """Push the cube to the goal from behind, for the rough table of -v3."""
    ee, velocity = observation[..., :3], observation[..., 12:14]
    return push_to(ee, achieved_goal, velocity, desired_goal)
