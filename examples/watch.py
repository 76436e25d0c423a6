"""Watch a policy: a video of several environments side by side, or a window.

    python examples/watch.py --policy runs/PandaPush-v1-ddpg-relabel-0 --out push.mp4
    python examples/watch.py --policy expert --env-id PandaStack-v1 --out stack.gif
    python examples/watch.py --policy expert --env-id PandaStack-v1 --human

Goals are drawn translucent; every cell says its step and turns green on success.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import numpy.typing as npt
import torch
import tyro
from PIL import Image, ImageDraw
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import step_mdp
from torchrl.envs.utils import ExplorationType, RandomPolicy, set_exploration_type
from tqdm import tqdm

import torch_panda
from agents import load_policy, read_checkpoint
from experts import make_expert
from limits import check_limits
from record_demos import prepare

CELL = (240, 320)  # height and width [pixels]
FPS = 25  # real time: the control frequency
BORDER = 4  # [pixels]
GREEN, GREY = (40, 170, 70), (120, 120, 120)


def record(
    env: torch_panda.RobotTaskEnv, policy: TensorDictModuleBase, path: Path
) -> None:
    """Write one episode of each environment into a video.

    Args:
        env: batched environment.
        policy: gives ``action``; run without exploration noise.
        path: an .mp4 or .gif file.

    Raises:
        ValueError: the file's name ends otherwise.
        OSError: the file could not be written.
    """
    if path.suffix not in (".mp4", ".gif"):
        raise ValueError(f"a video's name must end in .mp4 or .gif, got {path.name!r}")
    prepare(path)
    frames = [
        draw(env, state, step)
        for step, state in enumerate(
            tqdm(play(env, policy), total=env.max_episode_steps + 1, unit="frame")
        )
    ]
    options = (
        {"loop": 0, "duration": 1000 / FPS} if path.suffix == ".gif" else {"fps": FPS}
    )
    iio.imwrite(path, np.stack(frames), **options)


def play(
    env: torch_panda.RobotTaskEnv, policy: TensorDictModuleBase
) -> Iterator[TensorDictBase]:
    """Run an episode: what it starts with, and what every step leads to."""
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        state = env.reset()
        yield state
        for _ in range(env.max_episode_steps):
            state = step_mdp(env.step(policy(state)))
            yield state


def show(
    env: torch_panda.RobotTaskEnv, policy: TensorDictModuleBase, episodes: int
) -> None:
    """Play episodes of the first environment in a window, in real time."""
    with env.open_window() as window:
        for episode in range(1, episodes + 1):
            due = time.perf_counter()
            success = False
            for state in play(env, policy):
                window.show(0)
                success = bool(state["success"][0])
                due += 1 / FPS
                time.sleep(max(0.0, due - time.perf_counter()))
            outcome = "success" if success else "no success"
            print(f"episode {episode} of {episodes}: {outcome}", flush=True)


def draw(
    env: torch_panda.RobotTaskEnv, state: TensorDictBase, step: int
) -> npt.NDArray[np.uint8]:
    """All environments in one picture, with step and success, (height, width, 3)."""
    cells = []
    for pixels, success in zip(env.render(size=CELL), state["success"], strict=True):
        cell = Image.fromarray(pixels.cpu().numpy())
        pen = ImageDraw.Draw(cell)
        color = GREEN if success else GREY
        pen.rectangle((0, 0, CELL[1] - 1, CELL[0] - 1), outline=color, width=BORDER)
        text = f"step {step}" + ("  success" if success else "")
        pen.text((2 * BORDER, 2 * BORDER), text, fill=color)
        cells.append(np.asarray(cell))
    return tile(cells)


def tile(cells: list[npt.NDArray[np.uint8]]) -> npt.NDArray[np.uint8]:
    """Lay pictures of one size out in rows, about as many as columns."""
    columns = int(np.ceil(np.sqrt(len(cells))))
    rows = int(np.ceil(len(cells) / columns))
    empty = np.full_like(cells[0], 255)
    cells = cells + [empty] * (rows * columns - len(cells))
    return np.vstack(
        [np.hstack(cells[r * columns : (r + 1) * columns]) for r in range(rows)]
    )


@dataclass
class Args:
    """What to watch, and where to write it."""

    policy: str = "expert"
    """a run's folder or checkpoint, "random", or "expert" """
    env_id: str | None = None
    """task; None means the one the policy was trained on, or Push"""
    num_envs: int = 6
    """environments side by side; with a window, episodes one after the other"""
    seed: int = 0
    """of the environments and of random actions"""
    out: Path = Path("watch.mp4")
    """video to write, .mp4 or .gif"""
    human: bool = False
    """show it in a window of pybullet's GUI instead, at the speed of the real robot"""


def main(args: Args) -> None:
    """Record a policy, or show it."""
    try:
        check_limits(args)
        torch.manual_seed(args.seed)
        checkpoint = None
        if args.policy not in ("random", "expert"):
            path = Path(args.policy)
            path = path / "checkpoint.pt" if path.is_dir() else path
            if not path.exists():
                raise ValueError(
                    f"a policy is random, expert or a run, got {args.policy!r}"
                )
            checkpoint = read_checkpoint(path)
        env_id = args.env_id or (checkpoint["env_id"] if checkpoint else "PandaPush-v1")
        num_envs = 1 if args.human else args.num_envs
        with torch_panda.make(env_id, num_envs=num_envs, seed=args.seed) as env:
            policy: TensorDictModuleBase
            if checkpoint:
                policy = load_policy(checkpoint, env)
            elif args.policy == "expert":
                policy = make_expert(env_id)
            else:
                policy = RandomPolicy(env.action_spec)
            if args.human:
                show(env, policy, args.num_envs)
            else:
                record(env, policy, args.out)
                print(f"wrote {args.out}")
    except (ValueError, OSError, torch_panda.BulletError) as error:
        raise SystemExit(str(error)) from None
    except KeyboardInterrupt:
        raise SystemExit("stopped") from None


if __name__ == "__main__":
    main(tyro.cli(Args))
