"""The loop of offline learning: gradient steps on a data set, and evaluations.

Between two steps, the state of a run consists of the networks, the optimizer and
torch's random generator. All three are saved, so `--resume` continues a run bit for
bit.
"""

import os
import time
import warnings
from dataclasses import asdict, replace
from pathlib import Path

import torch
from tensordict import TensorDictBase
from tqdm import tqdm

from torch_panda.learning.agents import find_agent
from torch_panda.learning.checkpoint import SAVE_INTERVAL, Checkpoint, Progress
from torch_panda.learning.curve import Curve
from torch_panda.learning.logger import make_logger
from torch_panda.learning.offline.options import OfflineArgs
from torch_panda.learning.offline_data import OfflineData
from torch_panda.learning.spaces import read_spaces
from torch_panda.registry import make

FIT_ROWS = 100_000  # transitions from which the normaliser computes its statistics


class OfflineRun:
    """Offline learning with its data set and agent.

    Args:
        args: Options of the run.
        out: Folder of the results.
        data: Transitions (n,) to learn from, see `OfflineData`.
        data_hash: Hash of the data, which must be the same when the run is resumed.

    Raises:
        TypeError: The task does not have one of the ``task_options``.
        ValueError: The options do not fit the task, the data or the files.
    """

    def __init__(
        self, args: OfflineArgs, out: Path, data: TensorDictBase, data_hash: str
    ) -> None:
        self.args = args
        torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
        torch.set_float32_matmul_precision("medium")  # as in `training.Run`
        torch.manual_seed(args.seed)
        cls = find_agent(args)
        self.env = make(args.env_id, device=args.device, **args.env_options)
        spaces, hp = read_spaces(self.env), args
        if spaces.geometry is None and args.relative_inputs != "none":
            warnings.warn(
                f"learning without relative inputs ({args.relative_inputs!r}), because "
                "they need a task whose observation_layout and goal_entries name all "
                "entries of its observations and goals: declare them, or pass "
                "--relative-inputs none",
                stacklevel=2,
            )
            hp = replace(args, relative_inputs="none")
        with torch.device(args.device):
            self.agent = cls(spaces, hp)
        data = data.to(args.device)
        self.data = OfflineData(
            data, self.env, self.agent.goal_strategies, self.agent.gamma
        )
        sample = self.sample(min(FIT_ROWS, len(self.data)))
        self.agent.normalizer.update(sample["observation"], sample["actor_goal"])
        self.curve = Curve(
            args.env_id,
            self.agent,
            out,
            device=args.device,
            logger=make_logger(args.logger, out, asdict(args)),
            offline=True,
            **args.env_options,
        )
        self.progress = Progress()
        self.checkpoint = Checkpoint(
            out, args, self.agent, None, self.progress, data_hash
        )
        if args.resume:
            self.checkpoint.load()

    def sample(self, batch_size: int) -> TensorDictBase:
        """Draw a batch with all entries that the agent needs."""
        return self.agent.extend(self.data.sample(batch_size), self.data)

    def train(self, stop: object = False) -> bool:
        """Learn until the last step, or until ``stop`` is true after a step.

        Returns:
            Whether the training reached the last step.

        Raises:
            OSError: A file cannot be written.
        """
        args, progress, checkpoint = self.args, self.progress, self.checkpoint
        self.curve.begin(checkpoint)
        bar = tqdm(initial=progress.steps, total=args.total_steps, unit="step")
        bar.set_description(f"{args.env_id} {args.algo} offline")
        bar.set_postfix(success=progress.success)
        while progress.steps < args.total_steps and not stop:
            started = time.perf_counter()
            losses = self.agent.update(self.sample(args.batch_size))
            sums = progress.loss_sums
            progress.loss_sums = {
                key: sums.get(key, 0.0) + float(loss) for key, loss in losses.items()
            }
            progress.steps += 1
            progress.seconds += time.perf_counter() - started
            bar.update()
            is_last = progress.steps == args.total_steps
            if is_last or progress.steps % args.eval_interval == 0:
                self.evaluate()
                bar.set_postfix(success=progress.success)
            if progress.steps % SAVE_INTERVAL == 0:
                checkpoint.save()
        bar.close()
        checkpoint.save()
        return progress.steps >= args.total_steps

    def evaluate(self) -> None:
        """Add a row to the curve, with the mean losses since the last one."""
        progress = self.progress
        steps = progress.steps - int(progress.curve[-1]["step"])
        means = {key: total / steps for key, total in progress.loss_sums.items()}
        self.curve.add(progress, means)
        progress.loss_sums = {}

    def close(self) -> None:
        """Close the environments."""
        self.env.close()
        self.curve.close()
