"""Watch a policy: a video of several environments side by side, or a window.

python examples/watch.py --policy runs/PandaPush-v1-ddpg-relabel-0 --out push.mp4
python examples/watch.py --policy expert --env-id PandaStack-v1 --out stack.gif
python examples/watch.py --policy expert --env-id PandaStack-v1 --human
"""

import time
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import RandomPolicy

import torch_panda
from experts import make_expert
from limits import Positive, Seed, check_limits
from training.policies import load_policy, read_checkpoint
from video import FPS, play, record


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


@dataclass
class Args:
    """What to watch, and where to write it."""

    policy: str = "expert"
    """a run's folder or checkpoint, "random", or "expert" """
    env_id: str | None = None
    """task; None means the one the policy was trained on, or Push"""
    num_envs: Positive = 6
    """environments side by side; with a window, episodes one after the other"""
    seed: Seed = 0
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
            if not Path(args.policy).exists():
                raise ValueError(
                    f"a policy is random, expert or a run, got {args.policy!r}"
                )
            checkpoint = read_checkpoint(Path(args.policy))
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
