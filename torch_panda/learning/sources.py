"""Where the batches of a training come from: environments, or a data set.

The loop calls `collect` once per iteration, and then `sample` for the batches of its
gradient steps.
"""

import math
from collections.abc import Callable, Iterator
from itertools import repeat

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.data import ReplayBuffer, TensorDictReplayBuffer, TensorStorage
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType

from torch_panda.envs import RobotTaskEnv
from torch_panda.learning.agents import Agent
from torch_panda.learning.buffers import PartRewards, make_buffer, select_sequences
from torch_panda.learning.environments import GoalEnv
from torch_panda.learning.environments.starts import StartReached
from torch_panda.learning.evaluation.curve import reseed
from torch_panda.learning.offline_data import OfflineData
from torch_panda.learning.options import DEMO_RATIO, Args

# With ``--start-at-reached``, each environment takes at most this number of steps in an
# iteration. Episodes that start in reached states need no more. The limit also cuts the
# other episodes, because all environments take the same number of steps.
MAX_STEPS_FROM_REACHED = 50
FIT_ROWS = 100_000  # rows of a data set from which the normaliser gets its statistics
# Batches that are drawn at once on a GPU. The CPU draws their goals. For one batch this
# takes longer than the gradient step, and for a hundred batches ten times as long.
DRAWN_AT_ONCE = 100

Batches = Iterator[tuple[TensorDictBase, TensorDictBase | None]]


def drawn_at_once(device: torch.device | None) -> int:
    """Number of batches that are drawn at once on a device."""
    return 1 if device is None or device.type == "cpu" else DRAWN_AT_ONCE


def draw_batches(
    draw: Callable[[int], TensorDictBase],
    batch_size: int,
    number: int,
    device: torch.device | None,
) -> Iterator[TensorDictBase]:
    """Draw batches, several of them at once on a GPU.

    Args:
        draw: Draws as many rows as its argument says.
        batch_size: Rows of a batch.
        number: Number of batches.
        device: Device of the rows.
    """
    at_once = drawn_at_once(device)
    for start in range(0, number, at_once):
        rows = draw(min(at_once, number - start) * batch_size)
        # `split` takes time even if there is nothing to split.
        yield from [rows] if at_once == 1 else rows.split(batch_size)


class Experience:
    """Transitions that an agent collects in environments, and demonstrations.

    Each iteration resets all environments, and steps each of them for the length of an
    episode (with ``--start-at-reached`` at most `MAX_STEPS_FROM_REACHED` steps). If
    success ends episodes, an environment may play several of them in one iteration.

    Args:
        args: Options of the training.
        env: Environments to explore.
        agent: Agent that explores.
        demos: Demonstrated transitions (n,), which are a part of each batch; or None.
    """

    def __init__(
        self, args: Args, env: GoalEnv, agent: Agent, demos: TensorDictBase | None
    ) -> None:
        self.args, self.env, self.agent = args, env, agent
        steps = env.max_episode_steps
        if args.start_at_reached:
            steps = min(steps, MAX_STEPS_FROM_REACHED)
        steps_per_iteration = args.num_envs * steps
        self.buffer = make_buffer(
            env,
            # The last iteration may go past `total_steps`.
            args.total_steps + steps_per_iteration,
            her=args.her,
            desired_ratio=args.desired_ratio,
            discount=agent.gamma,
            seed=args.seed,
        )
        has_part_critics = args.critics == "parts"
        if has_part_critics:
            self.buffer.append_transform(PartRewards(env.compute_reward))
        self.num_demos = 0  # demonstrated transitions in each batch
        if demos is not None:
            demos = demos.to(env.device)
            agent.normalizer.update(demos["observation"], demos["desired_goal"])
            storage = TensorStorage(demos, device=env.device)
            self.demos = TensorDictReplayBuffer(storage=storage)
            if has_part_critics:
                self.demos.append_transform(PartRewards(env.compute_reward))
            self.num_demos = int(DEMO_RATIO * args.batch_size)
        explored: EnvBase = env
        # What a run needs to be resumed.
        self.buffers: dict[str, ReplayBuffer] = {"buffer": self.buffer}
        if args.start_at_reached:
            starts = StartReached(args.start_at_reached)
            self.buffers["reached"] = starts.states
            explored = TransformedEnv(env, starts)
        # A batch [num_envs, steps] begins with a reset of all environments. Episodes
        # that are still running at its end are cut.
        self.collector = Collector(
            explored,
            agent.explore,
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
        self._rollouts = iter(self.collector)

    def __len__(self) -> int:
        return len(self.buffer)

    def collect(self) -> int:
        """Step the environments, and store the transitions."""
        # From torch's generator, so that a resumed run has the same episodes.
        reseed(self.env)
        data = next(self._rollouts)
        self.store(data)
        return data.numel()

    def store(self, data: TensorDictBase) -> None:
        """Add a batch [num_envs, steps] to the buffer and to the normaliser."""
        data = select_sequences(data, self.args.keep_unmoved)
        if len(data):
            indices = self.buffer.extend(data.reshape(-1))
            # Reading rows back relabels them. As in Baselines, the normaliser's
            # statistics include hindsight goals.
            stored = self.buffer[indices]
            normalizer = self.agent.normalizer
            normalizer.update(stored["observation"], stored["desired_goal"])

    def sample(self, batch_size: int, number: int) -> Batches:
        """Draw batches from the buffer, and `DEMO_RATIO` of each from the demos."""
        device = self.env.device
        size = batch_size - self.num_demos
        batches = draw_batches(self.buffer.sample, size, number, device)
        if not self.num_demos:
            return zip(batches, repeat(None), strict=False)
        demos = draw_batches(self.demos.sample, self.num_demos, number, device)
        return zip(batches, demos, strict=True)

    def close(self) -> None:
        """Stop the collector, and close the environments."""
        self.collector.shutdown()


class DataSet:
    """Transitions of a data set, with goals that the agent draws.

    An iteration is one gradient step, and on a GPU as many as evenly divide the steps
    between evaluations, at most `DRAWN_AT_ONCE`.

    Args:
        args: Options of the training.
        env: Environment of the task, for its function `is_success`.
        agent: Agent that learns from the data.
        data: Transitions (n,), see `OfflineData`.
    """

    def __init__(
        self, args: Args, env: RobotTaskEnv, agent: Agent, data: TensorDictBase
    ) -> None:
        self.env, self.agent = env, agent
        self.buffers: dict[str, ReplayBuffer] = {}  # the data need not be saved
        at_once = drawn_at_once(env.device)
        self.steps = math.gcd(at_once, args.eval_interval, args.total_steps)
        self.data = OfflineData(
            data.to(env.device), env, agent.goal_strategies, agent.gamma
        )
        sample = self.draw(min(FIT_ROWS, len(self.data)))
        agent.normalizer.update(sample["observation"], sample["actor_goal"])

    def __len__(self) -> int:
        return len(self.data)

    def collect(self) -> int:
        """Count the gradient steps of an iteration."""
        return self.steps

    def draw(self, size: int) -> TensorDictBase:
        """Draw transitions with all entries that the agent needs, (size,)."""
        return self.agent.extend(self.data.sample(size), self.data)

    def sample(self, batch_size: int, number: int) -> Batches:
        """Draw batches."""
        batches = draw_batches(self.draw, batch_size, number, self.env.device)
        return zip(batches, repeat(None), strict=False)

    def close(self) -> None:
        """Close the environment."""
        self.env.close()
