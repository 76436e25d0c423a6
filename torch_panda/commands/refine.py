"""Refine a policy: let it imitate its own episodes, with the goals that they achieved.

    python -m torch_panda refine runs/PandaSlide-v1-ddpg-relabel-0 --out runs/slide

An episode that misses its goal shows how to reach the goal that it achieved instead.
So the policy plays episodes, the desired goal of each episode is replaced by the goal
achieved at its end, and the policy imitates these episodes. This is goal-conditioned
supervised learning (arXiv 1912.06088), which here starts from a trained policy. It
needs no rewards, no demonstrations and no exploration noise.
"""

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs.utils import ExplorationType
from tqdm import tqdm

import torch_panda
from torch_panda.datasets.recording import play
from torch_panda.learning.agents import AGENTS
from torch_panda.learning.buffers import STORED_KEYS, make_buffer
from torch_panda.learning.evaluation.curve import Curve, reseed
from torch_panda.learning.files.policy_files import SavedPolicy
from torch_panda.learning.files.run_files import (
    Checkpoint,
    Progress,
    check_folder,
    lock_folder,
    write_options,
)
from torch_panda.learning.limits import Positive, Seed, check_limits
from torch_panda.learning.training import SAVE_INTERVAL, StopSignal, crossed
from torch_panda.learning.user_modules import Imports, import_modules

LEARNING_RATE = 0.3  # first learning rate, as a fraction of the rate of training


@dataclass
class Args:
    """Refine a policy by imitation of its own episodes."""

    policy: Annotated[Path, tyro.conf.Positional]
    """folder of a run, or its checkpoint.pt"""
    out: Path
    """folder of the results, with the files of a run of `train` except the video"""
    env_id: str | None = None
    """another task with the same spaces; None means the task of the policy"""
    steps: Positive = 640_000
    """environment steps to play, rounded up to one episode per environment. Of the
    episodes that end at a goal of the task, the last million steps are imitated"""
    updates: Positive = 60_000
    """gradient steps of imitation, during which the learning rate falls to 0"""
    batch_size: Positive = 1024
    """transitions per gradient step"""
    num_envs: Positive = 64
    """number of environments stepped in parallel"""
    seed: Seed = 0
    """seed of the environments and the sampling"""
    imports: Imports = ()
    """module or .py file to import first, which registers ids of your own"""
    resume: bool = False
    """continue the run in the folder. Only --out and --import may differ from the
    options with which it was started"""


class Refinement:
    """A refinement with its agent, its played episodes and its progress.

    Raises:
        ValueError: There is no such policy, or no such run to resume.
    """

    def __init__(self, args: Args) -> None:
        self.args = args
        torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
        torch.manual_seed(args.seed)
        saved = SavedPolicy.read(args.policy)
        args.env_id = args.env_id or saved.env_id
        self.env = torch_panda.make(args.env_id, num_envs=args.num_envs)
        self.agent = saved.make_agent(self.env)
        if saved.hp.offline:
            raise ValueError(
                f"{args.policy} was learned offline by {saved.hp.algo}, but refine "
                f"improves policies of {', '.join(AGENTS)}: choose one of these"
            )
        rng = np.random.default_rng(0)
        goals = [self.env.task.sample_start(rng).goal for _ in range(100)]
        self.varies = torch.from_numpy(np.ptp(goals, axis=0) > 0)
        iteration = args.num_envs * self.env.max_episode_steps
        self.buffer = make_buffer(self.env, args.steps + iteration, her="none")
        self.curve = Curve(args.env_id, self.agent, args.out, device="cpu")
        self.progress = Progress()
        self.checkpoint = Checkpoint(
            args.out, args, self.agent, self.buffer, self.progress
        )
        if args.resume:
            self.checkpoint.load()

    def run(self, stop: object = False) -> bool:
        """Play and then imitate, until all steps are taken or until ``stop`` is true.

        Returns:
            Whether all steps were taken.

        Raises:
            ValueError: No episode ended at a goal that the task could draw.
        """
        args, progress, checkpoint = self.args, self.progress, self.checkpoint
        if len(progress.curve) > 1:
            return True
        self.curve.begin(checkpoint)
        self.play(stop)
        checkpoint.save()
        if stop:
            return False
        if not len(self.buffer):
            raise ValueError(
                "no episode ended at a goal that the task could draw, so there is "
                "nothing to imitate: train the policy for longer first"
            )
        pretrain(
            checkpoint,
            self.buffer,
            updates=args.updates,
            batch_size=args.batch_size,
            learning_rate=LEARNING_RATE,
            stop=stop,
        )
        if progress.pretrained < args.updates:
            return False
        self.curve.add(progress)
        checkpoint.save()
        return True

    def play(self, stop: object) -> None:
        """Play episodes, relabel them, and store those that reach their new goal."""
        progress, last = self.progress, self.args.steps
        bar = tqdm(desc="playing", initial=progress.steps, total=last, unit="step")
        while progress.steps < last and not stop:
            reseed(self.env)
            policy = self.agent.policy
            # mypy takes the members of this enum for strings.
            exploration = ExplorationType.DETERMINISTIC
            episodes = play(self.env, policy, exploration)  # type: ignore[arg-type]
            relabelled = [
                relabel(episode, self.env.task, self.varies) for episode in episodes
            ]
            if rows := [row for row in relabelled if row is not None]:
                self.buffer.extend(TensorDict.cat(rows))
            steps, before = sum(map(len, episodes)), progress.steps
            progress.steps += steps
            bar.update(steps)
            if crossed(SAVE_INTERVAL, before, progress.steps):
                self.checkpoint.save()
        bar.close()

    def close(self) -> None:
        """Free the environments."""
        self.env.close()
        self.curve.close()


def relabel(
    episode: TensorDictBase, task: torch_panda.Task, varies: Tensor
) -> TensorDictBase | None:
    """Replace the goal of an episode by the goal that it achieved at its end.

    Args:
        episode: The transitions, (steps,).
        task: Task, for its function `is_success`.
        varies: Whether each entry of the task's goals differs between episodes,
            (goal_dim,) bool. The other entries are not replaced. For example, the
            resting puck of Slide is lower than all goals, so the height of the goal is
            kept.

    Returns:
        A copy of the episode, or None if its end does not succeed with the new goal.
    """
    end = episode["next", "achieved_goal"][-1]
    goal = torch.where(varies, end, episode["desired_goal"][0])
    if not task.is_success(end, goal):
        return None
    episode = episode.select(*STORED_KEYS, strict=False)
    for key in ("desired_goal", ("next", "desired_goal")):
        episode[key] = goal.expand_as(episode[key])
    return episode


def pretrain(
    checkpoint: Checkpoint,
    demos: TensorDictReplayBuffer,
    *,
    updates: int,
    batch_size: int,
    learning_rate: float = 1.0,
    stop: object,
) -> None:
    """Take the remaining gradient steps of imitation, and save the run.

    The learning rate falls linearly to 0.

    Args:
        checkpoint: State of the run.
        demos: Demonstrations.
        updates: Total number of gradient steps, including the steps before a resume.
        batch_size: Transitions per gradient step.
        learning_rate: Learning rate of the first step, divided by `LEARNING_RATE`.
        stop: Object that becomes true to end the imitation early, such as `StopSignal`.
    """
    agent, progress = checkpoint.agent, checkpoint.progress
    bar = tqdm(
        desc="imitation", initial=progress.pretrained, total=updates, unit="update"
    )
    while progress.pretrained < updates and not stop:
        started = time.perf_counter()
        agent.set_learning_rate(learning_rate * (1 - progress.pretrained / updates))
        agent.imitate(demos.sample(batch_size))
        progress.pretrained += 1
        progress.seconds += time.perf_counter() - started
        bar.update()
        if progress.pretrained % SAVE_INTERVAL == 0:
            checkpoint.save()
    bar.close()
    agent.set_learning_rate(1.0)
    checkpoint.save()


def main(args: Args) -> None:
    """Refine, and print where the results are."""
    try:
        check_limits(args)
        import_modules(args.imports)
        check_folder(args.out, resume=args.resume)
        run = Refinement(args)
        default = Args(args.policy, args.out, env_id=args.env_id)
        more = {"algo": run.agent.hp.algo, "preset": "refined"}
        stop = StopSignal()
        with lock_folder(args.out):
            write_options(args.out, args, default, resume=args.resume, **more)
            finished = run.run(stop)
    except (ValueError, OSError) as error:
        raise SystemExit(str(error)) from None
    stop.release()
    run.close()
    before, now = run.progress.curve[0]["success"], run.progress.success
    print(f"success {now}, before {before:.0%}; see {args.out}")
    if not finished:
        print(
            f"stopped and saved in {args.out}: the same command with --resume goes on"
        )


def run(arguments: Sequence[str]) -> None:
    """Read the options and run the command."""
    main(tyro.cli(Args, prog="python -m torch_panda refine", args=arguments))
