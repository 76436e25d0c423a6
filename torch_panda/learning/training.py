"""The training loop: get steps from a source of batches, then take gradient steps.

The source is a set of environments or a data set; see `sources`. With demonstrations, a
training may begin with iterations that imitate them.

A run is saved between two iterations only. With environments, the next iteration begins
with a reset. So neither their state nor that of a data set need be saved, and
``--resume`` continues the run bit for bit. Gradient steps use OMP_NUM_THREADS threads,
by default one.
"""

import os
import signal
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import Tensor
from tqdm import tqdm

from torch_panda.envs import RobotTaskEnv
from torch_panda.envs.randomization import Randomization
from torch_panda.learning.agents import make_agent
from torch_panda.learning.environments import GoalEnv, make_env
from torch_panda.learning.evaluation.curve import NUM_ENVS, Curve
from torch_panda.learning.files.logger import make_logger
from torch_panda.learning.files.run_files import Checkpoint, Progress
from torch_panda.learning.options import Args
from torch_panda.learning.sources import DataSet, Experience

# Steps between two saves, including gradient steps of imitation.
SAVE_INTERVAL = 20_000
# A task is solved after this many evaluations in a row in which all episodes succeed.
SOLVED_EVALUATIONS = 3


class Run:
    """A training with its environments, its agent and the source of its batches.

    Args:
        args: Options of the training.
        out: Folder of the results.
        data: Transitions (n,), as `torch_panda.datasets.read_demos` returns them. With
            the option ``offline``, they are the data set to learn from. Otherwise they
            are demonstrations, which are a part of each batch.
        data_hash: Hash of the data, which must be the same when the run is resumed.
        make_own_env: Makes environments of your own, from their number; see `GoalEnv`.
            The id of the options is then only a name. None makes those of the id.

    Raises:
        TypeError: The task does not have one of the ``task_options``.
        ValueError: An option does not fit the task, the data or another option, or the
            run to resume cannot be read.
    """

    def __init__(
        self,
        args: Args,
        out: Path,
        data: TensorDictBase | None = None,
        data_hash: str = "",
        *,
        make_own_env: Callable[[int], GoalEnv] | None = None,
    ) -> None:
        self.args = args
        torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
        # With "medium", PyTorch leaves products of float32 matrices to oneDNN. On CPUs
        # with AVX-512, they are up to twice as fast as with "highest", but may be
        # rounded to bfloat16 inside a product.
        torch.set_float32_matmul_precision("medium")
        torch.manual_seed(args.seed)
        # The constructor of the collector calls the exploration once, before the first
        # `reseed`. With exploration "points", this call may draw a point near an
        # object. The point depends on the first observation, and therefore on the seed.
        if make_own_env is None:
            self.env = self._make_env()
        else:
            self.env = make_own_env(args.num_envs)
            self.env.set_seed(args.seed)
        self.agent = make_agent(self.env, args)
        self.source: Experience | DataSet
        if args.offline:
            assert data is not None and isinstance(self.env, RobotTaskEnv)
            self.source = DataSet(args, self.env, self.agent, data)
        else:
            self.source = Experience(args, self.env, self.agent, data)
        self.curve = Curve(
            args.env_id,
            self.agent,
            out,
            device=args.device,
            logger=make_logger(args.logger, out, asdict(args)),
            env=None if make_own_env is None else make_own_env(NUM_ENVS),
            offline=args.offline,
            workers=args.workers,
            **args.env_options,
        )
        self.progress = Progress()
        self.checkpoint = Checkpoint(
            out, args, self.agent, self.source.buffer, self.progress, data_hash
        )
        if args.resume:
            self.checkpoint.load()

    def _make_env(self) -> GoalEnv:
        """Make the environments of the options, for training."""
        args, options = self.args, dict(self.args.env_options)
        if args.randomize > 1:
            factors = (1 / args.randomize, args.randomize)
            options["randomize"] = Randomization(
                object_mass=factors, object_friction=factors, table_friction=factors
            )
        return make_env(
            args.env_id,
            # With a data set, `num_envs` is the number that generated it.
            num_envs=1 if args.offline else args.num_envs,
            workers=args.workers,
            seed=args.seed,
            device=args.device,
            **options,
        )

    def train(self, stop: object = False) -> bool:
        """Train until the last step, or until ``stop`` is true after an iteration.

        Args:
            stop: Object that becomes true to end the training early, such as
                `StopSignal`.

        Returns:
            Whether the training reached the last step.

        Raises:
            OSError: A file cannot be written.
        """
        args, progress = self.args, self.progress
        self.curve.begin(self.checkpoint)
        bar = tqdm(
            desc=f"{args.env_id} {args.algo}",
            initial=progress.iterated,
            total=args.pretrain_updates + args.total_steps,
            unit="step",
        )
        finished = stopped = self.is_finished()
        while not stopped:
            started, before = time.perf_counter(), progress.iterated
            if progress.pretrained < args.pretrain_updates:
                is_row = self.imitate()
            else:
                is_row = self.iterate()
            progress.seconds += time.perf_counter() - started
            bar.update(progress.iterated - before)
            if is_row:
                self.curve.add(progress, self.mean_losses())
                progress.loss_sums = {}
            finished = self.is_finished()
            bar.set_postfix(success=progress.success)
            stopped = finished or bool(stop)
            if stopped or crossed(SAVE_INTERVAL, before, progress.iterated):
                self.checkpoint.save()
        bar.close()
        return finished

    def is_finished(self) -> bool:
        """Whether the last step was taken, or the task is solved."""
        args, progress = self.args, self.progress
        last = [row["success"] for row in progress.curve[-SOLVED_EVALUATIONS:]]
        is_solved = len(last) == SOLVED_EVALUATIONS and min(last) == 1.0
        is_last = (
            progress.pretrained >= args.pretrain_updates
            and progress.steps >= args.total_steps
        )
        return is_last or (args.stop_when_solved and is_solved)

    def imitate(self) -> bool:
        """Take one gradient step of imitation. The learning rate falls linearly to 0.

        Returns:
            Whether it was the last one, so that the policy is to be evaluated.
        """
        args, progress = self.args, self.progress
        self.agent.set_learning_rate(1 - progress.pretrained / args.pretrain_updates)
        assert isinstance(self.source, Experience)  # a data set has no demonstrations
        self.agent.imitate(self.source.demos.sample(args.batch_size))
        progress.pretrained += 1
        is_last = progress.pretrained == args.pretrain_updates
        if is_last:
            self.agent.set_learning_rate(1.0)
        return is_last

    def iterate(self) -> bool:
        """Get steps from the source, and take the gradient steps that are then due.

        Returns:
            Whether the policy is to be evaluated.
        """
        args, progress = self.args, self.progress
        before = progress.steps
        steps = self.source.collect()
        progress.steps += steps
        losses = self.learn()
        # With a data set, a row of the curve has the mean over all gradient steps since
        # the last row. Otherwise it has the mean over those of one iteration.
        sums, weight = (progress.loss_sums, steps) if args.offline else ({}, 1)
        progress.loss_sums = {
            key: sums.get(key, 0.0) + weight * x for key, x in losses.items()
        }
        is_last = progress.steps >= args.total_steps
        return is_last or crossed(args.eval_interval, before, progress.steps)

    def learn(self) -> dict[str, float]:
        """Take the gradient steps that are due after the steps so far.

        Returns:
            The mean of each loss over these steps.
        """
        args, agent = self.args, self.agent
        losses: dict[str, list[Tensor]] = defaultdict(list)
        due = int(self.progress.steps * args.updates_per_step) - agent.updates
        number = due if len(self.source) else 0
        for batch, demos in self.source.sample(args.batch_size, number):
            for key, loss in agent.update(batch, demos).items():
                losses[key].append(loss)
        return {key: float(torch.stack(x).mean()) for key, x in losses.items()}

    def mean_losses(self) -> dict[str, float]:
        """The losses for the next row of the curve."""
        progress = self.progress
        count = 1
        if self.args.offline:
            count = progress.steps - int(progress.curve[-1]["step"])
        return {key: total / count for key, total in progress.loss_sums.items()}

    def close(self) -> None:
        """Close the environments."""
        self.source.close()
        self.curve.close()


def crossed(interval: int, before: int, after: int) -> bool:
    """Whether a multiple of ``interval`` lies in (before, after]."""
    return before // interval < after // interval


class StopSignal:
    """Becomes true on Ctrl-C or SIGTERM. A second signal ends the program at once."""

    def __init__(self) -> None:
        self.received = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._receive)

    def _receive(self, number: int, frame: object) -> None:
        self.received = True
        self.release()
        tqdm.write("stopping after this iteration; press Ctrl-C again to stop at once")

    def release(self) -> None:
        """Give the signals their usual effect again."""
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)

    def __bool__(self) -> bool:
        return self.received
