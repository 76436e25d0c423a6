"""Watch a policy in a video, in a window, or in a browser.

python -m torch_panda watch --policy runs/PandaPush-v1-ddpg-relabel-0 --out push.mp4
python -m torch_panda watch --policy expert --env-id PandaStack-v1 --out stack.gif
python -m torch_panda watch --policy expert --env-id PandaStack-v1 --human
python -m torch_panda watch --policy runs/PandaPush-v1-ddpg-relabel-0 --web
"""

import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import RandomPolicy

import torch_panda
from torch_panda.experts import make_expert
from torch_panda.learning.environments import make_env, refusal
from torch_panda.learning.evaluation.video import play, record
from torch_panda.learning.files.policy_files import load_policy
from torch_panda.learning.limits import Port, Positive, Seed, check_limits
from torch_panda.learning.user_modules import Imports, import_modules

CAMERA = torch_panda.Camera(distance=1.1)  # view at the start in a browser


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
                due += 1 / env.render_fps
                time.sleep(max(0.0, due - time.perf_counter()))
                if state["done"][0]:
                    break  # a -v3 episode ends at its first success
            outcome = "success" if success else "no success"
            print(f"episode {episode} of {episodes}: {outcome}", flush=True)


def serve(
    env: torch_panda.RobotTaskEnv,
    policies: Iterator[TensorDictModuleBase],
    *,
    host: str,
    port: int,
    allowed_hosts: Sequence[str],
) -> None:
    """Play episodes in a browser, in real time.

    Args:
        env: Environments. The user of the page chooses which one it shows.
        policies: One policy per episode.
        host: Network address that serves the page.
        port: Port of the page. If it is taken, the next free port is used.
        allowed_hosts: Further names of this machine under which browsers may open the
            page.
    """
    with env.open_viewer(
        CAMERA, host=host, port=port, allowed_hosts=allowed_hosts
    ) as viewer:
        print(f"open {viewer.url} in a browser; Ctrl-C ends it", flush=True)
        for number, policy in enumerate(policies, 1):
            viewer.write(f"episode {number}")
            for _ in play(env, policy):
                due = time.perf_counter() + 1 / env.render_fps
                viewer.update()
                viewer.wait()
                time.sleep(max(0.0, due - time.perf_counter()))


def follow(path: Path) -> Iterator[TensorDictModuleBase]:
    """Yield the policy of a run, and read it again whenever a training has saved it.

    Args:
        path: Folder of the run, or a checkpoint.
    """
    file = path / "checkpoint.pt" if path.is_dir() else path
    seen = None
    while True:
        saved = file.stat().st_mtime_ns
        if saved != seen:
            policy, seen = load_policy(file), saved
        yield policy


@dataclass
class Args:
    """Watch a policy in a video, in a window, or in a browser."""

    policy: str = "expert"
    """folder or checkpoint of a run, an id whose policy torch_panda ships, "random", or
    "expert" """
    env_id: str | None = None
    """task; None means the task of the policy, or Push"""
    num_envs: Positive = 6
    """number of environments in the picture; with --human, number of episodes"""
    seed: Seed = 0
    """seed of the environments and of random actions"""
    out: Path = Path("watch.mp4")
    """video to write, a .mp4 or .gif file"""
    human: bool = False
    """show the episodes in a window of pybullet's GUI instead, in real time"""
    web: bool = False
    """show the episodes in a browser instead (needs the extra "viewer"). If the policy
    is a run that is still training, it is read again whenever the training saves it"""
    host: str = "127.0.0.1"
    """with --web, network address that serves the page; 0.0.0.0 also serves it to other
    machines"""
    port: Port = 8080
    """with --web, port of the page; if it is taken, the next free port"""
    allowed_hosts: tuple[str, ...] = ()
    """with --web, further names of this machine under which browsers may open the page;
    needed with --host 0.0.0.0, if other machines open the page by its name"""
    imports: Imports = ()
    """module or .py file to import first, which registers ids of your own"""


def main(args: Args) -> None:
    """Record a policy as a video, or show it."""
    try:
        check_limits(args)
        if args.human and args.web:
            raise ValueError(
                "human and web show the episodes in different places: pass one of them"
            )
        import_modules(args.imports)
        torch.manual_seed(args.seed)
        trained = None
        if args.policy not in ("random", "expert"):
            trained = load_policy(args.policy)
        env_id = args.env_id or (trained.env_id if trained else "PandaPush-v1")
        num_envs = 1 if args.human else args.num_envs
        with make_env(env_id, num_envs=num_envs, seed=args.seed, renders=True) as env:
            if args.human or args.web:
                if not isinstance(env, torch_panda.RobotTaskEnv):
                    raise refusal(env_id, "window", "viewer")
                robot_env = env
            policy: TensorDictModuleBase
            if trained:
                policy = trained
            elif args.policy == "expert":
                policy = make_expert(env_id)
            else:
                # A callable is enough for rollouts.
                policy = RandomPolicy(env.action_spec)  # type: ignore[assignment]
            if args.web:
                policies: Iterator[TensorDictModuleBase] = itertools.repeat(policy)
                if trained and Path(args.policy).exists():
                    policies = follow(Path(args.policy))
                serve(
                    robot_env,
                    policies,
                    host=args.host,
                    port=args.port,
                    allowed_hosts=args.allowed_hosts,
                )
            elif args.human:
                show(robot_env, policy, args.num_envs)
            else:
                record(env, policy, args.out)
                print(f"wrote {args.out}")
    except (ValueError, OSError, ImportError, torch_panda.BulletError) as error:
        raise SystemExit(str(error)) from None


def run(arguments: Sequence[str]) -> None:
    """Read the options and run the command."""
    main(tyro.cli(Args, prog="python -m torch_panda watch", args=arguments))
