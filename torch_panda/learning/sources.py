"""Where the batches of a training come from: environments, or a data set.

The loop calls `collect` once per iteration, and `sample` for each gradient step.
"""

from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.data import ReplayBuffer, TensorDictReplayBuffer, TensorStorage
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType

from torch_panda.envs import RobotTaskEnv
from torch_panda.learning.agents import Agent
from torch_panda.learning.buffers import make_buffer, select_sequences
from torch_panda.learning.environments import GoalEnv
from torch_panda.learning.environments.starts import StartFrom, states_at_objects
from torch_panda.learning.evaluation.curve import reseed
from torch_panda.learning.offline_data import OfflineData
from torch_panda.learning.options import DEMO_RATIO, Args

# With ``--start-at-object``, each environment takes at most this number of steps in an
# iteration. Episodes that start in the middle of the task need no more. The limit also
# cuts the other episodes, because all environments take the same number of steps.
MAX_STEPS_FROM_MIDDLE = 50
FIT_ROWS = 100_000  # rows of a data set from which the normaliser gets its statistics


class Experience:
    """Transitions that an agent collects in environments, and demonstrations.

    Each iteration resets all environments, and steps each of them for the length of an
    episode (with ``--start-at-object`` at most `MAX_STEPS_FROM_MIDDLE` steps). If
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
        if args.start_at_object:
            steps = min(steps, MAX_STEPS_FROM_MIDDLE)
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
        self.num_demos = 0  # demonstrated transitions in each batch
        if demos is not None:
            demos = demos.to(env.device)
            agent.normalizer.update(demos["observation"], demos["desired_goal"])
            storage = TensorStorage(demos, device=env.device)
            self.demos = TensorDictReplayBuffer(storage=storage)
            self.num_demos = int(DEMO_RATIO * args.batch_size)
        explored: EnvBase = env
        if args.start_at_object:
            states = states_at_objects(args.env_id, seed=args.seed, **args.env_options)
            explored = TransformedEnv(env, StartFrom(states, args.start_at_object))
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

    def sample(self, batch_size: int) -> tuple[TensorDictBase, TensorDictBase | None]:
        """Draw transitions from the buffer, and `DEMO_RATIO` of them from the demos."""
        batch = self.buffer.sample(batch_size - self.num_demos)
        return batch, self.demos.sample(self.num_demos) if self.num_demos else None

    def close(self) -> None:
        """Stop the collector, and close the environments."""
        self.collector.shutdown()


class DataSet:
    """Transitions of a data set, with goals that the agent draws.

    An iteration is one gradient step.

    Args:
        env: Environment of the task, for its function `is_success`.
        agent: Agent that learns from the data.
        data: Transitions (n,), see `OfflineData`.
    """

    buffer: ReplayBuffer | None = None  # its state need not be saved

    def __init__(self, env: RobotTaskEnv, agent: Agent, data: TensorDictBase) -> None:
        self.env, self.agent = env, agent
        self.data = OfflineData(
            data.to(env.device), env, agent.goal_strategies, agent.gamma
        )
        sample, _ = self.sample(min(FIT_ROWS, len(self.data)))
        agent.normalizer.update(sample["observation"], sample["actor_goal"])

    def __len__(self) -> int:
        return len(self.data)

    def collect(self) -> int:
        """Count one step."""
        return 1

    def sample(self, batch_size: int) -> tuple[TensorDictBase, None]:
        """Draw transitions with all entries that the agent needs."""
        return self.agent.extend(self.data.sample(batch_size), self.data), None

    def close(self) -> None:
        """Close the environment."""
        self.env.close()
