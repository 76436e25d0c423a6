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
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import Tensor
from tqdm import tqdm

from torch_panda.envs import RobotTaskEnv
from torch_panda.envs.randomization import Randomization
from torch_panda.learning.agents import make_agent
from torch_panda.learning.agents.stacked import StackedAgents
from torch_panda.learning.environments import GoalEnv, make_env
from torch_panda.learning.evaluation.curve import NUM_ENVS, Curve
from torch_panda.learning.files.logger import make_logger
from torch_panda.learning.files.run_files import (
    Checkpoint,
    Progress,
    check_folder,
)
from torch_panda.learning.limits import check_limits
from torch_panda.learning.options import Args
from torch_panda.learning.sources import Batches, DataSet, Experience

# Steps between two saves, including gradient steps of imitation.
SAVE_INTERVAL = 20_000
# A task is solved after this many evaluations in a row in which all episodes succeed.
SOLVED_EVALUATIONS = 3


class Run:
    """A training with its environments, its agent and the source of its batches.

    Args:
        args: Options of the training.
        out: Folder of the results, which is made if it does not exist.
        data: Transitions (n,), as `torch_panda.datasets.read_demos` returns them. With
            the option ``offline``, they are the data set to learn from. Otherwise they
            are demonstrations, which are a part of each batch.
        data_hash: Hash of the data, which must be the same when the run is resumed.
        make_own_env: Makes environments of your own, from their number; see `GoalEnv`.
            The id of the options is then only a name. None makes those of the id.

    Raises:
        TypeError: The task does not have one of the ``task_options``.
        ValueError: An option is out of its limits or does not fit the task, the data or
            another option, the run to resume cannot be read, or the folder holds a run
            that is not resumed.
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
        check_limits(args)
        check_folder(out, resume=args.resume)
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
            out, args, self.agent, self.source.buffers, self.progress, data_hash
        )
        if args.resume:
            self.checkpoint.load()
        self.random_state = torch.get_rng_state()
        out.mkdir(parents=True, exist_ok=True)

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
        """Train this run alone; see `Training.train`."""
        return Training([self]).train(stop)

    def iterate(self) -> bool:
        """Imitate, or else get steps from the source and learn from them.

        Returns:
            Whether the policy is to be evaluated.
        """
        if self.progress.pretrained < self.args.pretrain_updates:
            return self.imitate()
        steps = self.collect()
        losses = [self.agent.update(batch, demos) for batch, demos in self.sample()]
        self.add_losses(losses, steps)
        return self.has_row(steps)

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

    def collect(self) -> int:
        """Get steps from the source, and return their number."""
        steps = self.source.collect()
        self.progress.steps += steps
        return steps

    def sample(self) -> Batches:
        """Draw the batches of the gradient steps that are due."""
        due = int(self.progress.steps * self.args.updates_per_step) - self.agent.updates
        return self.source.sample(self.args.batch_size, due if len(self.source) else 0)

    def add_losses(self, losses: Sequence[dict[str, Tensor]], steps: int) -> None:
        """Add the losses of an iteration, which took ``steps`` steps.

        With a data set, a row of the curve has the mean over all gradient steps since
        the last row. Otherwise it has the mean over those of one iteration.
        """
        sums, weight = (
            (self.progress.loss_sums, steps) if self.args.offline else ({}, 1)
        )
        lists: dict[str, list[Tensor]] = defaultdict(list)
        for step in losses:
            for key, loss in step.items():
                lists[key].append(loss)
        self.progress.loss_sums = {
            key: sums.get(key, 0.0) + weight * float(torch.stack(x).mean())
            for key, x in lists.items()
        }

    def has_row(self, steps: int) -> bool:
        """Whether the policy is to be evaluated after an iteration of these steps."""
        args, after = self.args, self.progress.steps
        is_last = after >= args.total_steps
        return is_last or crossed(args.eval_interval, after - steps, after)

    def evaluate(self) -> None:
        """Evaluate the policy, and write the results."""
        progress = self.progress
        count = 1
        if self.args.offline:
            count = progress.steps - int(progress.curve[-1]["step"])
        losses = {key: total / count for key, total in progress.loss_sums.items()}
        self.curve.add(progress, losses)
        progress.loss_sums = {}

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

    def close(self) -> None:
        """Close the environments."""
        self.source.close()
        self.curve.close()


class Training:
    """The training loop, of one run or of several that learn together.

    Runs that learn together learn from a data set, and differ in their seeds. Each has
    its files and its random numbers, as if it learned alone.

    Args:
        runs: The runs.

    Raises:
        ValueError: The runs have taken different numbers of steps.
    """

    def __init__(self, runs: Sequence[Run]) -> None:
        self.runs = runs
        steps = [run.progress.steps for run in runs]
        if len(set(steps)) > 1:
            raise ValueError(
                f"runs that learn together must have taken the same number of steps, "
                f"got {', '.join(map(str, steps))}: continue each alone, with --seed"
            )
        self.stacked: StackedAgents | None = None
        if len(runs) > 1:
            self.stacked = StackedAgents([run.agent for run in runs])
        self._random_states = [run.random_state for run in runs]

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
        # All runs have taken the same number of steps, with the same options.
        args, progress = self.runs[0].args, self.runs[0].progress
        for run in self._each():
            run.curve.begin(run.checkpoint)
        bar = tqdm(
            desc=f"{args.env_id} {args.algo}",
            initial=progress.iterated,
            total=args.pretrain_updates + args.total_steps,
            unit="step",
        )
        finished = stopped = all(run.is_finished() for run in self.runs)
        while not stopped:
            started, before = time.perf_counter(), progress.iterated
            is_row = self._iterate()
            seconds = time.perf_counter() - started
            bar.update(progress.iterated - before)
            for run in self.runs:
                run.progress.seconds += seconds
            if is_row:
                self._write_back()
                for run in self._each():
                    run.evaluate()
            finished = all(run.is_finished() for run in self.runs)
            bar.set_postfix(success=" ".join(run.progress.success for run in self.runs))
            stopped = finished or bool(stop)
            if stopped or crossed(SAVE_INTERVAL, before, progress.iterated):
                self._write_back()
                for run in self._each():
                    run.checkpoint.save()
        bar.close()
        return finished

    def close(self) -> None:
        """Close the environments."""
        for run in self.runs:
            run.close()

    def _each(self) -> Iterator[Run]:
        """Go through the runs, each with its state of torch's random generator."""
        if self.stacked is None:
            yield from self.runs
            return
        for i, run in enumerate(self.runs):
            torch.set_rng_state(self._random_states[i])
            yield run
            self._random_states[i] = torch.get_rng_state()

    def _write_back(self) -> None:
        """Copy stacked weights to the agents of the runs."""
        if self.stacked is not None:
            self.stacked.write_back()

    def _iterate(self) -> bool:
        """Take the steps of one iteration.

        Returns:
            Whether the policies are to be evaluated.
        """
        if self.stacked is None:
            return self.runs[0].iterate()
        drawn, steps = [], 0
        for run in self._each():
            steps = run.collect()
            drawn.append([batch for batch, _ in run.sample()])
        losses = [self.stacked.update(batches) for batches in zip(*drawn, strict=True)]
        for i, run in enumerate(self.runs):
            run.add_losses([step[i] for step in losses], steps)
        return self.runs[0].has_row(steps)


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
