"""Scripted experts: they show that each task can be solved, and give demonstrations.

    python examples/experts.py --env-id PandaPush-v1 --episodes 200 --out demos.pt

An expert maps a batch of observations and goals to actions of end-effector control. It
has no state and sees no simulator: what to do next follows from the observation alone,
so experts serve rollouts and collectors of any batch size. Positions are in the world
frame [m]; an action of 1 displaces the end-effector by 5 cm.
"""

import os
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from math import prod
from pathlib import Path

import torch
import tyro
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from tqdm import tqdm

import torch_panda
from evaluate import wilson_interval
from flip_expert import flip
from limits import check_limits
from moves import (
    CUBE,
    carry,
    drag_to,
    go_over,
    go_to,
    is_held,
    norm,
    push_to,
    unit,
)

# (observation, achieved_goal, desired_goal), each (..., size), to the action.
Expert = Callable[[Tensor, Tensor, Tensor], Tensor]


@dataclass
class Args:
    """Which expert to run, for how long, and where to write."""

    env_id: str = "PandaPush-v1"
    """one of torch_panda.ENV_IDS with end-effector control"""
    episodes: int = 200
    """episodes to run"""
    seed: int = 0
    """of the environments"""
    num_envs: int = 32
    """environments that are stepped in parallel"""
    num_threads: int | None = None
    """threads that step them; None means one per core"""
    out: Path | None = None
    """where to save the transitions, a nested dict of tensors of shape (steps, ...)"""


# ---- tasks -----------------------------------------------------------------------


def reach(observation: Tensor, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
    """Go straight to the goal."""
    return go_to(achieved_goal, desired_goal)


def push(observation: Tensor, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
    """Push the cube to the goal."""
    ee, velocity = observation[..., :3], observation[..., 12:14]
    return push_to(ee, achieved_goal, velocity, desired_goal)


def drag(observation: Tensor, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
    """Drag the cube to the goal, pressing on it: struck, it would slide too far."""
    return drag_to(observation[..., :3], achieved_goal, desired_goal)


def pick_and_place(
    observation: Tensor, achieved_goal: Tensor, desired_goal: Tensor
) -> Tensor:
    """Carry the cube to the goal and hold it there."""
    ee, width = observation[..., :3], observation[..., 6:7]
    return carry(ee, width, achieved_goal, desired_goal)


def stack(observation: Tensor, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
    """Carry the lower cube to its goal, then the upper one onto it.

    A cube that leaves the fingers no room beside the lower one is pushed aside first.
    """
    ee, width = observation[..., :3], observation[..., 6:7]
    lower, upper = achieved_goal.split(3, -1)
    lower_speed, upper_speed = (norm(observation[..., k : k + 3]) for k in (13, 25))
    lower_held, upper_held = is_held(ee, width, lower), is_held(ee, width, upper)
    goal, top = desired_goal[..., :3], lower + lower.new_tensor((0.0, 0.0, CUBE))

    def arrived(error: Tensor, speed: Tensor, held: Tensor, tolerance: float) -> Tensor:
        return torch.where(held, (error < 0.01) & (speed < 0.1), error < tolerance)

    placed = arrived(norm(lower - goal), lower_speed, lower_held, 0.025)
    stacked = arrived(norm(upper - top), upper_speed, upper_held, 0.02)
    to_lower, to_upper = norm(ee - lower), norm(ee - upper)
    leave = (to_lower < 0.06) & (to_lower < to_upper) & ~upper_held
    leave = leave | placed & stacked & (ee[..., 2:] < 0.15)
    # Rising while the fingers open would take the cube along.
    upwards = torch.where((width < 0.02) | (width > 0.06), 1.0, 0.0)
    rise = torch.cat((0 * ee[..., :2], upwards, 0.4 + 0 * width), -1)
    finish = torch.where(stacked, 0.0, carry(ee, width, upper, top, clearance=0.06))
    finish = torch.where(leave, rise, finish)

    # The fingers need room beside the lower cube, where it lies and where it goes.
    room = upper.new_tensor((0.045, 0.085))

    def crowds(point: Tensor) -> Tensor:
        return ((upper - point)[..., :2].abs() < room).all(-1, True)

    at = torch.where(crowds(lower) | placed, lower, goal)
    apart = (upper - at)[..., :2]
    along_x = apart[..., :1].abs() > apart[..., 1:].abs()
    # `push_to` may leave it 3 cm short of there.
    sign = torch.where(apart < 0, -1.0, 1.0)
    side = at[..., :2] + sign * apart.new_tensor((0.1, 0.125))
    x, y, z = upper.split(1, -1)
    x, y = (
        torch.where(along_x, side[..., :1], x),
        torch.where(along_x, y, side[..., 1:]),
    )
    aside = torch.cat((x, y, z), -1)
    clear = push_to(ee, upper, observation[..., 25:27], aside)
    clear = torch.cat((clear, 0 * width - 1), -1)
    on_top = upper[..., 2:] > 0.03
    blocked = crowds(at) & ~(lower_held | upper_held | placed & on_top)
    action = torch.where(placed, finish, carry(ee, width, lower, goal))
    action = torch.where(blocked, torch.where(leave, rise, clear), action)
    # What is as it should be, held or not, is not touched again.
    done = torch.maximum(norm(lower - goal), norm(upper - desired_goal[..., 3:])) < 0.03
    hold = torch.cat((0 * ee, torch.where(upper_held, -1.0, 0.0)), -1)
    return torch.where(done, hold, action)


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


def slide(observation: Tensor, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
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


# ---- running them ----------------------------------------------------------------

EXPERTS: dict[str, Expert] = {
    "Reach": reach,
    "Push": drag,
    "Slide": slide,
    "PickAndPlace": pick_and_place,
    "Stack": stack,
    "Flip": flip,
}


# On the rougher table of -v3 a cube can be pushed.
V3_EXPERTS: dict[str, Expert] = EXPERTS | {"Push": push}


def make_expert(env_id: str) -> TensorDictModule:
    """The policy for an id of end-effector control.

    Raises:
        ValueError: there is no expert for it.
    """
    match = re.fullmatch(r"Panda([A-Za-z]+?)(Dense)?-v([13])", env_id)
    if match is None or match[1] not in EXPERTS:
        raise ValueError(
            f"no expert for {env_id!r}; accepted are "
            f"Panda{{{','.join(EXPERTS)}}}{{,Dense}}-v{{1,3}}"
        )
    keys = ["observation", "achieved_goal", "desired_goal"]
    experts = EXPERTS if match[3] == "1" else V3_EXPERTS
    return TensorDictModule(experts[match[1]], keys, ["action"])


def play(
    env: torch_panda.RobotTaskEnv, expert: TensorDictModule
) -> list[TensorDictBase]:
    """One fresh episode of every environment, each with its transitions (steps,)."""
    with torch.no_grad():
        rollout = env.rollout(
            env.max_episode_steps,
            expert,
            break_when_any_done=False,
            break_when_all_done=True,
        )
    ended = rollout["next", "done"].squeeze(-1)
    lengths = (ended.cumsum(1) == 0).sum(1) + 1
    return [row[:length] for row, length in zip(rollout, lengths.tolist(), strict=True)]


def prepare(path: Path) -> None:
    """Make a file's folder, so that what takes long to make will not be lost.

    Raises:
        OSError: the file could not be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir() or not os.access(path.parent, os.W_OK):
        raise OSError(f"cannot write to {path}")


def main(args: Args) -> None:
    """Run the episodes, print the success rates, save the transitions."""
    try:
        check_limits(args)
        expert = make_expert(args.env_id)
        if args.out is not None:
            prepare(args.out)
        env = torch_panda.make(
            args.env_id,
            num_envs=args.num_envs,
            num_threads=args.num_threads,
            seed=args.seed,
        )
    except (ValueError, OSError) as error:
        raise SystemExit(str(error)) from None
    episodes: list[TensorDictBase] = []
    with env, tqdm(total=args.episodes, unit="episode", desc=args.env_id) as progress:
        while len(episodes) < args.episodes:
            new = play(env, expert)[: args.episodes - len(episodes)]
            episodes += new
            progress.update(len(new))
    success = [episode["next", "success"] for episode in episodes]
    for when, count in (
        ("at the end", sum(bool(flags[-1]) for flags in success)),
        ("at any time", sum(bool(flags.any()) for flags in success)),
    ):
        low, high = wilson_interval(count, args.episodes)
        print(
            f"{args.env_id}: success {when} {count}/{args.episodes} = "
            f"{count / args.episodes:.1%} (95 % interval {low:.1%} to {high:.1%})"
        )
    if args.out is not None:
        transitions = TensorDict.cat(episodes)
        # The key by which collectors, and HindsightRelabel, tell trajectories apart.
        lengths = torch.tensor([len(episode) for episode in episodes])
        transitions["collector", "traj_ids"] = torch.arange(
            len(episodes)
        ).repeat_interleave(lengths)
        torch.save(transitions.to_dict(), args.out)
        print(f"{len(transitions)} transitions in {args.out}")


if __name__ == "__main__":
    main(tyro.cli(Args))
