"""Record demonstrations of the scripted experts, and say how often they succeed.

python examples/record_demos.py --env-id PandaPush-v1 --episodes 200 --out demos.pt
"""

from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import AdditiveGaussianModule
from tqdm import tqdm

import torch_panda
from evaluate import wilson_interval
from experts import make_expert
from limits import Positive, Seed, Weight, check_limits
from training.files import prepare, save


@dataclass
class Args:
    """Which expert to run, for how long, and where to write."""

    env_id: str = "PandaPush-v1"
    """one of torch_panda.ENV_IDS with end-effector control"""
    episodes: Positive = 200
    """episodes to run"""
    seed: Seed = 0
    """of the environments"""
    num_envs: Positive = 32
    """environments that are stepped in parallel"""
    num_threads: Positive | None = None
    """threads that step them; None means one per core"""
    noise_eps: Weight = 0.0
    """the standard deviation of Gaussian noise on the actions that are executed; saved
    are the actions without it, so that who imitates them learns to correct himself
    (DART, arXiv 1703.09327)"""
    successful: bool = False
    """save only the episodes that succeed at the end"""
    out: Path | None = None
    """where to save the transitions, a nested dict of tensors of shape (steps, ...)"""


def disturb(
    expert: TensorDictModule, env: torch_panda.RobotTaskEnv, noise_eps: float
) -> TensorDictModuleBase:
    """The expert with noise on its ``action``, which is kept as ``intended``."""
    keep = TensorDictModule(torch.clone, ["action"], ["intended"])
    noise = AdditiveGaussianModule(
        env.action_spec, sigma_init=noise_eps, sigma_end=noise_eps
    )
    return TensorDictSequential(expert, keep, noise)


def play(
    env: torch_panda.RobotTaskEnv, expert: TensorDictModuleBase
) -> list[TensorDictBase]:
    """One fresh episode of every environment, each with its transitions (steps,)."""
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        rollout = env.rollout(
            env.max_episode_steps,
            expert,
            break_when_any_done=False,
            break_when_all_done=True,
        )
    ended = rollout["next", "done"].squeeze(-1)
    lengths = (ended.cumsum(1) == 0).sum(1) + 1
    return [row[:length] for row, length in zip(rollout, lengths.tolist(), strict=True)]


def join(episodes: list[TensorDictBase]) -> TensorDictBase:
    """The transitions of all episodes, one after the other, numbered by episode."""
    transitions = TensorDict.cat(episodes)
    # The key by which collectors, and HindsightRelabel, tell trajectories apart.
    lengths = torch.tensor([len(episode) for episode in episodes])
    numbers = torch.arange(len(episodes)).repeat_interleave(lengths)
    transitions["collector", "traj_ids"] = numbers
    return transitions


def print_success(env_id: str, episodes: list[TensorDictBase]) -> None:
    """Print how many episodes succeeded, with 95 % intervals."""
    success = [episode["next", "success"] for episode in episodes]
    for when, count in (
        ("at the end", sum(bool(flags[-1]) for flags in success)),
        ("at any time", sum(bool(flags.any()) for flags in success)),
    ):
        low, high = wilson_interval(count, len(episodes))
        print(
            f"{env_id}: success {when} {count}/{len(episodes)} = "
            f"{count / len(episodes):.1%} (95 % interval {low:.1%} to {high:.1%})"
        )


def main(args: Args) -> None:
    """Run the episodes, print the success rates, save the transitions."""
    try:
        check_limits(args)
        expert: TensorDictModuleBase = make_expert(args.env_id)
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
    expert = disturb(expert, env, args.noise_eps)
    episodes: list[TensorDictBase] = []
    try:
        with env, tqdm(total=args.episodes, unit="episode", desc=args.env_id) as bar:
            while len(episodes) < args.episodes:
                new = play(env, expert)[: args.episodes - len(episodes)]
                episodes += new
                bar.update(len(new))
        print_success(args.env_id, episodes)
        if args.out is not None:
            if args.successful:
                episodes = [x for x in episodes if x["next", "success"][-1]]
                if not episodes:
                    raise SystemExit("no episode succeeded: nothing was saved")
            demos = join(episodes)
            demos["action"] = demos.pop("intended")
            # Ctrl-C leaves the file as it was, or makes the whole of it.
            save(args.out, demos.to_dict())
            print(f"{len(demos)} transitions in {args.out}")
    except KeyboardInterrupt:
        raise SystemExit("stopped") from None


if __name__ == "__main__":
    main(tyro.cli(Args))
