"""The training loop: steps of parallel environments, then gradient steps.

Each iteration resets all environments, steps each of them for the length of an episode
(with ``--start-at-object`` at most `MAX_STEPS_FROM_MIDDLE` steps), and then takes
``updates_per_step`` gradient steps per environment step. If success ends episodes, an
environment may play several of them in one iteration.

A run is saved between two iterations only. The next iteration begins with a reset, so
the state of the environments need not be saved, and ``--resume`` continues the run bit
for bit. Gradient steps use OMP_NUM_THREADS threads, by default one.
"""

import os
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import TensorDictReplayBuffer, TensorStorage
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType
from tqdm import tqdm

from torch_panda.envs.randomization import Randomization
from torch_panda.learning.agents import make_agent
from torch_panda.learning.buffers import make_buffer, select_sequences
from torch_panda.learning.checkpoint import (
    SAVE_INTERVAL,
    Checkpoint,
    Progress,
    crossed,
)
from torch_panda.learning.curve import NUM_ENVS, Curve, reseed
from torch_panda.learning.environments import GoalEnv, make_env
from torch_panda.learning.logger import make_logger
from torch_panda.learning.options import DEMO_RATIO, Args
from torch_panda.learning.pretraining import pretrain
from torch_panda.learning.starts import StartFrom, states_at_objects

# With ``--start-at-object``, each environment takes at most this number of steps in an
# iteration. Episodes that start in the middle of the task need no more. The limit also
# cuts the other episodes, because all environments take the same number of steps.
MAX_STEPS_FROM_MIDDLE = 50
# Of the sequences in which the achieved goal does not change (see `buffers.has_moved`),
# the replay buffer stores this fraction. A sequence is the steps of one environment in
# one iteration. The preset "paper" stores all of them.
KEEP_UNMOVED = 0.1
# A task is solved after this many evaluations in a row in which all episodes succeed.
SOLVED_EVALUATIONS = 3


class Run:
    """A training with its environments, agent and replay buffer.

    Args:
        args: Options of the training.
        out: Folder of the results.
        demos: Demonstrated transitions (n,), as `torch_panda.datasets.read_demos`
            returns them. They are a part of each batch.
        demos_hash: Hash of the demonstrations, which must be the same when the run is
            resumed.
        make_own_env: Makes environments of your own, from their number; see `GoalEnv`.
            The id of the options is then only a name. None makes those of the id.

    Raises:
        TypeError: The task does not have one of the ``task_options``.
        ValueError: An option does not fit the task or another option, or the run to
            resume cannot be read.
    """

    def __init__(
        self,
        args: Args,
        out: Path,
        demos: TensorDictBase | None = None,
        demos_hash: str = "",
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
        steps = self.env.max_episode_steps
        if args.start_at_object:
            steps = min(steps, MAX_STEPS_FROM_MIDDLE)
        steps_per_iteration = args.num_envs * steps
        self.buffer = make_buffer(
            self.env,
            # The last iteration may go past `total_steps`.
            args.total_steps + steps_per_iteration,
            her=args.her,
            desired_ratio=args.desired_ratio,
            discount=self.agent.gamma,
            seed=args.seed,
        )
        self.num_demos = 0  # demonstrated transitions in each batch
        if demos is not None:
            demos = demos.to(self.env.device)
            self.agent.normalizer.update(demos["observation"], demos["desired_goal"])
            storage = TensorStorage(demos, device=self.env.device)
            self.demos = TensorDictReplayBuffer(storage=storage)
            self.num_demos = int(DEMO_RATIO * args.batch_size)
        env: EnvBase = self.env
        if args.start_at_object:
            states = states_at_objects(args.env_id, seed=args.seed, **args.env_options)
            env = TransformedEnv(env, StartFrom(states, args.start_at_object))
        # A batch [num_envs, steps] begins with a reset of all environments. Episodes
        # that are still running at its end are cut.
        self.collector = Collector(
            env,
            self.agent.explore,
            frames_per_batch=steps_per_iteration,
            total_frames=-1,
            reset_at_each_iter=True,
            # mypy takes the members of this enum for strings.
            exploration_type=ExplorationType.RANDOM,  # type: ignore[arg-type]
            auto_register_policy_transforms=True,
            # Without this, ids of trajectories stay on the CPU, and a resumed buffer on
            # a GPU cannot store them.
            storing_device=args.device,
        )
        self.curve = Curve(
            args.env_id,
            self.agent,
            out,
            device=args.device,
            logger=make_logger(args.logger, out, asdict(args)),
            env=None if make_own_env is None else make_own_env(NUM_ENVS),
            workers=args.workers,
            **args.env_options,
        )
        self.progress = Progress()
        self.checkpoint = Checkpoint(
            out, args, self.agent, self.buffer, self.progress, demos_hash
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
        if args.continue_after_success:
            options["terminate_on_success"] = False
        return make_env(
            args.env_id,
            num_envs=args.num_envs,
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
        args, progress, checkpoint = self.args, self.progress, self.checkpoint
        self.curve.begin(checkpoint)
        if progress.pretrained < args.pretrain_updates:
            pretrain(
                checkpoint,
                self.demos,
                updates=args.pretrain_updates,
                batch_size=args.batch_size,
                stop=stop,
            )
            if progress.pretrained < args.pretrain_updates:
                return False
        if args.pretrain_updates and len(progress.curve) == 1:
            self.curve.add(progress)  # the policy after imitation
            checkpoint.save()

        bar = tqdm(initial=progress.steps, total=args.total_steps, unit="step")
        bar.set_description(f"{args.env_id} {args.algo}")
        finished = stopped = self.is_finished()
        batches = iter(self.collector)
        while not stopped:
            started, before = time.perf_counter(), progress.steps
            # From torch's generator, so that a resumed run has the same episodes.
            reseed(self.env)
            data = next(batches)
            progress.steps += data.numel()
            self.store(data)
            losses = self.learn()
            progress.seconds += time.perf_counter() - started

            bar.update(data.numel())
            is_last = progress.steps >= args.total_steps
            if is_last or crossed(args.eval_interval, before, progress.steps):
                self.curve.add(progress, losses)
            finished = self.is_finished()
            bar.set_postfix(success=progress.success)
            stopped = finished or bool(stop)
            if stopped or crossed(SAVE_INTERVAL, before, progress.steps):
                checkpoint.save()
        bar.close()
        return finished

    def is_finished(self) -> bool:
        """Whether the last step was taken, or the task is solved."""
        args, progress = self.args, self.progress
        last = [row["success"] for row in progress.curve[-SOLVED_EVALUATIONS:]]
        is_solved = len(last) == SOLVED_EVALUATIONS and min(last) == 1.0
        is_last = progress.steps >= args.total_steps
        return is_last or (args.stop_when_solved and is_solved)

    def store(self, data: TensorDictBase) -> None:
        """Add a batch [num_envs, steps] to the buffer and to the normaliser."""
        keep_unmoved = 1.0 if self.args.preset == "paper" else KEEP_UNMOVED
        data = select_sequences(data, keep_unmoved)
        if len(data):
            indices = self.buffer.extend(data.reshape(-1))
            # Reading rows back relabels them. As in Baselines, the normaliser's
            # statistics include hindsight goals.
            stored = self.buffer[indices]
            normalizer = self.agent.normalizer
            normalizer.update(stored["observation"], stored["desired_goal"])

    def learn(self) -> dict[str, float]:
        """Take the gradient steps that are due after the environment steps so far.

        Returns:
            The mean of each loss over these steps.
        """
        args, agent = self.args, self.agent
        losses: dict[str, list[Tensor]] = defaultdict(list)
        due = int(self.progress.steps * args.updates_per_step) - agent.updates
        for _ in range(due if len(self.buffer) else 0):
            if args.anneal_lr:
                total = args.updates_per_step * args.total_steps
                # The last iteration may exceed the total number of updates.
                agent.set_learning_rate(max(0.0, 1 - agent.updates / total))
            batch = self.buffer.sample(args.batch_size - self.num_demos)
            demos = self.demos.sample(self.num_demos) if self.num_demos else None
            for key, loss in agent.update(batch, demos).items():
                losses[key].append(loss)
        return {key: float(torch.stack(x).mean()) for key, x in losses.items()}

    def close(self) -> None:
        """Close the environments."""
        self.collector.shutdown()
        self.curve.close()
