"""Scripted experts: they show that each task can be solved, and give demonstrations.

    python examples/experts.py --env-id PandaPush-v1 --episodes 200 --out demos.pt

An expert maps a batch of observations and goals to actions of end-effector control. It
has no state and sees no simulator: what to do next follows from the observation alone,
so experts serve rollouts and collectors of any batch size. Positions are in the world
frame [m]; an action of 1 displaces the end-effector by 5 cm.
"""

import math
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

# (observation, achieved_goal, desired_goal), each (..., size), to the action.
Expert = Callable[[Tensor, Tensor, Tensor], Tensor]

GAIN = 0.8 / 0.05  # actions per metre: the arm covers 0.8 of an offset in a step
GRIPPER = 0.2  # [m] that an action of 1 opens the fingers
OPEN = 0.075  # [m], fingers' width before a grasp
DECELERATION = 0.25 * 9.81  # [m/s^2] of a cube that slides on the table
CUBE = 0.04  # [m], edge length


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


# ---- moves -----------------------------------------------------------------------


def norm(vector: Tensor) -> Tensor:
    """Length, (..., n) to (..., 1)."""
    return torch.linalg.vector_norm(vector, dim=-1, keepdim=True)


def unit(vector: Tensor) -> Tensor:
    """Direction, (..., n)."""
    return vector / norm(vector).clamp(min=1e-6)


def move(offset: Tensor, limit: float = 1.0) -> Tensor:
    """The action that displaces by an offset [m], at most ``limit`` long."""
    action = GAIN * offset
    return action / (norm(action) / limit).clamp(min=1.0)


def go_to(position: Tensor, point: Tensor, limit: float = 1.0) -> Tensor:
    """Straight to a point."""
    return move(point - position, limit)


def go_over(
    position: Tensor, point: Tensor, clearance: float, limit: float = 1.0
) -> Tensor:
    """To a point from above: rise by ``clearance`` first, descend when over it."""
    offset = point - position
    height = (2 * (norm(offset[..., :2]) - 0.01)).clamp(0.0, clearance)
    rise = offset[..., 2:] + height
    free = (1 - rise / 0.05).clamp(0.0, 1.0)  # how high it is already
    return move(torch.cat((offset[..., :2] * free, rise), -1), limit)


def push_to(ee: Tensor, cube: Tensor, velocity: Tensor, goal: Tensor) -> Tensor:
    """Get behind a cube, seen from the goal, and push until it will slide there.

    Args:
        ee: end-effector, (..., 3).
        cube: its position, (..., 3).
        velocity: of the cube along x and y [m/s], (..., 2).
        goal: where to push it, (..., 3).
    """
    offset, beside, height = (goal - cube)[..., :2], (ee - cube)[..., :2], cube[..., 2:]
    distance, direction = norm(offset), unit(offset)
    along = (beside * direction).sum(-1, keepdim=True)
    lateral = beside - along * direction
    behind = torch.cat((cube[..., :2] - 0.06 * direction, height), -1)
    pushing = (along < -0.02) & (norm(lateral) < 0.02) & (ee[..., 2:] < height + 0.02)
    left = distance - velocity.square().sum(-1, keepdim=True) / (2 * DECELERATION)
    step = (0.5 * left).clamp(0.0, 0.025) * direction - lateral
    advance = move(torch.cat((step, height - ee[..., 2:]), -1))
    # A cube within 3 cm is left alone: another approach would disturb it.
    done = (left < 0.01) | ~pushing & (distance < 0.03)
    action = torch.where(pushing, advance, go_over(ee, behind, 0.06))
    return torch.where(done, 0.0, action)


def is_held(ee: Tensor, width: Tensor, cube: Tensor) -> Tensor:
    """Whether the fingers hold a cube; they may slide along y while they do."""
    offset = (cube - ee).abs() < ee.new_tensor((0.02, 0.04, 0.02))
    return (width > 0.02) & (width < 0.05) & offset.all(-1, keepdim=True)


def open_to(width: Tensor, wanted: float) -> Tensor:
    """The gripper's action for a width [m]."""
    return ((wanted - width) / GRIPPER).clamp(-1.0, 1.0)


def carry(
    ee: Tensor, width: Tensor, cube: Tensor, goal: Tensor, clearance: float = 0.0
) -> Tensor:
    """Grasp a cube and carry it to a point: the action with the gripper, (..., 4)."""
    offset = cube - ee
    near = (norm(offset[..., :2]) < 0.015) & (offset[..., 2:].abs() < 0.01)
    held = is_held(ee, width, cube)
    transport = go_over(cube, goal, clearance, limit=0.6)
    displacement = torch.where(held, transport, go_over(ee, cube, 0.1))
    gripper = torch.where(near | held, -1.0, open_to(width, OPEN))
    return torch.cat((displacement, gripper), -1)


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


def wilson_interval(successes: int, episodes: int) -> tuple[float, float]:
    """The 95 % interval of a rate (Wilson's score interval)."""
    z = 1.96
    rate, scale = successes / episodes, 1 + z * z / episodes
    spread = z * math.sqrt(rate * (1 - rate) / episodes + (z / episodes / 2) ** 2)
    centre = rate + z * z / (2 * episodes)
    return (centre - spread) / scale, (centre + spread) / scale


def main(args: Args) -> None:
    """Run the episodes, print the success rates, save the transitions."""
    if args.episodes < 1:
        raise SystemExit(f"episodes must be at least 1, got {args.episodes}")
    try:
        expert = make_expert(args.env_id)
        env = torch_panda.make(
            args.env_id,
            num_envs=args.num_envs,
            num_threads=args.num_threads,
            seed=args.seed,
        )
    except ValueError as error:
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
