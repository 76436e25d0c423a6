"""Scripted experts: they show that each task can be solved, and give demonstrations.

    python examples/experts.py --env-id PandaPush-v1 --episodes 200 --out demos.pt

An expert maps a batch of observations and goals to actions of end-effector control. It
has no state and sees no simulator: what to do next follows from the observation alone,
so experts serve rollouts and collectors of any batch size. Positions are in the world
frame [m]; an action of 1 displaces the end-effector by 5 cm.
"""

import os
import re
from collections.abc import Callable
from dataclasses import dataclass
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
from moves import CUBE, carry, go_over, go_to, is_held, norm, push_to, unit

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
    """where to save the transitions, a TensorDict of shape (steps,)"""


# ---- tasks -----------------------------------------------------------------------


def reach(observation: Tensor, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
    """Go straight to the goal."""
    return go_to(achieved_goal, desired_goal)


def push(observation: Tensor, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
    """Push the cube to the goal."""
    velocity = observation[..., 12:14]
    return push_to(observation[..., :3], achieved_goal, velocity, desired_goal)


def pick_and_place(
    observation: Tensor, achieved_goal: Tensor, desired_goal: Tensor
) -> Tensor:
    """Carry the cube to the goal and hold it there."""
    ee, width = observation[..., :3], observation[..., 6:7]
    return carry(ee, width, achieved_goal, desired_goal)


def stack(observation: Tensor, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
    """Carry the lower cube to its goal, then the upper one onto it; let go of both.

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
    leave = leave | stacked & (ee[..., 2:] < 0.15)
    rise = torch.cat((0 * ee[..., :2], 1 + 0 * width, 0.4 + 0 * width), -1)
    finish = torch.where(stacked, 0.0, carry(ee, width, upper, top, clearance=0.06))
    finish = torch.where(leave, rise, finish)

    apart = upper - lower
    blocked = (apart[..., :2].abs() < apart.new_tensor((0.045, 0.085))).all(-1, True)
    side = torch.where(apart[..., :1] > 0, 0.1, -0.1)
    aside = torch.cat((lower[..., :1] + side, upper[..., 1:]), -1)
    clear = push_to(ee, upper, observation[..., 25:27], aside)
    clear = torch.cat((clear, 0 * width - 1), -1)
    start = torch.where(blocked & ~lower_held, clear, carry(ee, width, lower, goal))
    return torch.where(placed, finish, start)


# How far the closed fingers reach along x and y from the end-effector, and the puck [m]
FINGERS_X, FINGERS_Y, PUCK_RADIUS = 0.008, 0.0217, 0.029
STRIKE_GAP = 0.008  # [m] between fingers and puck before the strike
# Action of the strike for a puck that should move by `distance` until the episode ends,
#   BIAS + DISTANCE * distance + STRETCH * r + STRETCH2 * r^2 + SIDE * |sin(direction)|,
# r: how much farther than 0.6 m from the arm's base the puck is [m]. A least-squares
# fit to 258 strikes of random strength (PandaSlide-v1, residual 0.03); BIAS is 0.006
# above the fit, for the median puck stopped 9 mm short.
BIAS, DISTANCE, STRETCH, STRETCH2, SIDE = 0.151, 0.593, 0.815, 4.6, -0.142


def slide(observation: Tensor, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
    """Strike the puck once, with a corner of the fingers, so that it stops there.

    The puck leaves along the line from the corner to its centre, hardly braked by
    friction; the arm moves in jerks, so that one action from a known gap gives a
    reproducible speed.
    """
    ee, ee_velocity = observation[..., :3], observation[..., 3:6]
    offset = (desired_goal - achieved_goal)[..., :2]
    distance, direction = norm(offset), unit(offset)
    sine = direction[..., 1:]
    corner = torch.cat((FINGERS_X + 0 * sine, FINGERS_Y * sine.sign()), -1)
    contact = achieved_goal[..., :2] - PUCK_RADIUS * direction - corner
    ready = contact - STRIKE_GAP * direction
    ready = torch.cat((ready, torch.full_like(sine, 0.015)), -1)
    base = observation.new_tensor((-0.6, 0.0))
    r = norm(achieved_goal[..., :2] - base) - 0.6
    amplitude = BIAS + DISTANCE * distance + r * (STRETCH + r * STRETCH2)
    strike = direction * (amplitude + SIDE * sine.abs())
    strike = torch.cat((strike, (ready - ee)[..., 2:] / 0.05), -1)
    set_up = (norm(ready - ee) < 0.001) & (norm(ee_velocity) < 0.05)
    action = torch.where(set_up, strike, go_over(ee, ready, 0.05))
    moving = norm(observation[..., 12:14]) > 0.05
    return torch.where(moving, 0.0, action)


# ---- running them ----------------------------------------------------------------

EXPERTS: dict[str, Expert] = {
    "Reach": reach,
    "Push": push,
    "Slide": slide,
    "PickAndPlace": pick_and_place,
    "Stack": stack,
    "Flip": flip,
}


def make_expert(env_id: str) -> TensorDictModule:
    """The policy for an id of end-effector control.

    Raises:
        ValueError: there is no expert for it.
    """
    match = re.fullmatch(r"Panda([A-Za-z]+?)(Dense)?-v[13]", env_id)
    if match is None or match[1] not in EXPERTS:
        raise ValueError(
            f"no expert for {env_id!r}; accepted are "
            f"Panda{{{','.join(EXPERTS)}}}{{,Dense}}-v{{1,3}}"
        )
    keys = ["observation", "achieved_goal", "desired_goal"]
    return TensorDictModule(EXPERTS[match[1]], keys, ["action"])


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
        torch.save(transitions, args.out)
        print(f"{len(transitions)} transitions in {args.out}")


if __name__ == "__main__":
    main(tyro.cli(Args))
