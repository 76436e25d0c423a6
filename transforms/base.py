"""What the two transforms have in common: arguments, and the buffer they belong to."""

from __future__ import annotations

import inspect
import threading
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.data import ReplayBuffer, SliceSampler
from torchrl.data.replay_buffers.sample_units import Sequence
from torchrl.envs import EnvBase, MultiStepTransform, ParallelEnv, SerialEnv
from torchrl.envs import Transform, TransformedEnv
from typing_extensions import Self

from torch_panda.transforms.checks import DataCheck
from torch_panda.transforms.goal_memory import GoalMemory
from torch_panda.transforms.rewrite import GoalFunction, Rewriter
from torch_panda.transforms.strategies import DESIRED, Strategy, parse_strategies
from torch_panda.transforms.trajectories import ids_of, time_first, time_last

SERIAL_KEY = "hindsight_serial"


class BufferTransform(Transform):
    """A transform of a replay buffer that writes other goals into transitions.

    Args:
        reward_fn: the environment's reward: maps (achieved_goal, desired_goal), each
            (n, *goal), to (n, 1), a row's by that row only. The first batches are
            compared with it.
        strategy: where goals are from: a name (see the classes), a function
            `(step, first, end, generator) -> goal step` (see `strategies`), or a
            mapping of these to weights (divided by their sum), drawn for every goal.
        success_fn: the same for the success, bool: also `success_key` is rewritten.
        terminated_fn: the same for tasks that end on success: also ("next",
            "terminated") and ("next", "done") are. What ended otherwise stays so.
        goal_key: the desired goal, rewritten in the root and under "next".
        achieved_goal_key: the achieved goal, read under "next" and in the root.
        reward_key: the reward.
        success_key: the success.
        trajectory_key: ids that tell trajectories apart. Data without them are taken
            for [*batch, time], one environment a row, in the same order every time.
        single_env: takes 1-d data without ids for one environment's steps.
        seed: seeds a generator of its own. By default torch's is used.
    """

    # Tells torchrl that processes which share the buffer must share this, too.
    requires_shared_write_state = True

    def __init__(
        self,
        reward_fn: GoalFunction,
        *,
        strategy: str | Strategy | Mapping[Any, float] = "future",
        success_fn: GoalFunction | None = None,
        terminated_fn: GoalFunction | None = None,
        goal_key: NestedKey = "desired_goal",
        achieved_goal_key: NestedKey = "achieved_goal",
        reward_key: NestedKey = ("next", "reward"),
        success_key: NestedKey = ("next", "success"),
        trajectory_key: NestedKey = ("collector", "traj_ids"),
        single_env: bool = False,
        seed: int | None = None,
    ) -> None:
        super().__init__()
        if not callable(reward_fn):
            raise ValueError(f"reward_fn must be a function, got {reward_fn!r}.")
        self.strategy = strategy
        self._weights = parse_strategies(strategy)
        self.trajectory_key = trajectory_key
        self.single_env = single_env
        functions = reward_fn, success_fn, terminated_fn
        keys = goal_key, achieved_goal_key, reward_key, success_key
        self._rewriter = Rewriter(*functions, *keys)
        self._check_data = DataCheck(self._rewriter)
        self._memory = GoalMemory(keeps_desired=DESIRED in self._weights)
        self._generator: torch.Generator | None = None
        if seed is not None:
            self._generator = torch.Generator("cpu").manual_seed(seed)
        self._is_chain_checked = False
        self._lock = threading.Lock()  # a prefetching buffer samples in threads

    @classmethod
    def from_env(cls, env: EnvBase, **options: Any) -> Self:  # noqa: ANN401 (any option)
        """Makes the transform that belongs to an environment.

        Its `compute_reward` and `is_success` become `reward_fn` and `success_fn`; the
        latter also `terminated_fn` if its `terminate_on_success` is true. A
        `TransformedEnv` has its base environment's; for a `ParallelEnv` or `SerialEnv`,
        which do not hand out functions, one more environment is made, and closed.

        Args:
            env: the environment, e.g. a `RobotTaskEnv`.
            **options: arguments of the constructor, these three included.

        Raises:
            ValueError: the environment lacks one that is not given.
        """
        while isinstance(env, TransformedEnv):
            env = env.base_env
        if isinstance(env, (ParallelEnv, SerialEnv)):
            worker = env.create_env_fn[0](**env.create_env_kwargs[0])
            try:
                return cls.from_env(worker, **options)
            finally:
                worker.close(raise_if_closed=False)
        for option, attribute in (
            ("reward_fn", "compute_reward"),
            ("success_fn", "is_success"),
            ("terminated_fn", "terminate_on_success"),
        ):
            try:
                value = (
                    options[option] if option in options else getattr(env, attribute)
                )
            except AttributeError as error:
                message = f"{type(env).__name__} has no {attribute}: give {option}=."
                raise ValueError(message) from error
            if option == "terminated_fn" and option not in options:
                value = options["success_fn"] if value else None
            options[option] = value
        return cls(**options)

    # -- the buffer -------------------------------------------------------------------

    def _writing_buffer(self) -> tuple[ReplayBuffer | None, str]:
        """Returns the buffer that is written to, None if none is calling, and how.

        Raises:
            RuntimeError: it makes rewards of n steps, or is not just extended.
        """
        name = type(self).__name__
        if not self._is_chain_checked and _has_multi_step(self):
            raise RuntimeError(
                f"{name} cannot be combined with MultiStepTransform: the reward of n "
                "steps cannot be recomputed from one transition. Sample slices with "
                'HindsightRelabel(unit="slice") instead.'
            )
        self._is_chain_checked = True
        buffer, method = calling_buffer()
        if buffer is not None and method not in ("extend", "add"):
            raise RuntimeError(
                f"{name} cannot follow a buffer in which {method} writes rows in the "
                "place of others. Use extend() or add()."
            )
        return buffer, method

    def _note(
        self, batch: TensorDictBase, stored: int, capacity: int | None
    ) -> TensorDictBase:
        """Remembers transitions [*batch, time]; tags them with their serials.

        Args:
            batch: the transitions.
            stored: how many are stored so far.
            capacity: how many may be, None if unknown.
        """
        shape = batch.batch_size
        self._rewriter.check(batch)
        self._check_data(batch)
        done = batch.get(("next", "done")).reshape(shape)
        achieved = batch.get(self._rewriter.next_achieved_key)
        root = batch.get(self._rewriter.achieved_goal_key, None)
        desired = batch.get(self._rewriter.goal_key)
        serial = self._memory.write(
            ids_of(batch, self.trajectory_key, self.single_env),
            time_first(done, len(shape)),
            time_first(achieved, len(shape)),
            None if root is None else time_first(root, len(shape)),
            time_first(desired, len(shape)),
            stored=stored,
            capacity=capacity,
        )
        return batch.set(SERIAL_KEY, time_last(serial, shape))

    def end_trajectories(self) -> None:
        """Ends all trajectories; what is written next begins new ones."""
        with self._lock:
            self._memory.tracker.open.clear()

    def empty(self) -> None:
        """Forgets all transitions, as the buffer's own `empty` does not tell to."""
        with self._lock:
            self._memory = GoalMemory(keeps_desired=DESIRED in self._weights)

    # -- what torchrl's machinery asks for --------------------------------------------

    def share_memory_(self) -> None:
        """Is called for a buffer that several processes write to: a RuntimeError."""
        raise RuntimeError(
            f"{type(self).__name__} has no share_memory_(): it follows what one "
            "process writes. Do not give the buffer to a multi-process collector "
            "(replay_buffer=), but extend it with what the collector yields."
        )

    def set_container(self, container: Transform | EnvBase) -> None:
        """Joins a buffer's chain of transforms; an environment's is a ValueError."""
        if isinstance(container, EnvBase) or container.parent is not None:
            self._call(None)
        super().set_container(container)
        self.empty_cache()

    def empty_cache(self) -> None:
        """Is called by a chain when it changes: n-step rewards are looked for again."""
        super().empty_cache()
        self._is_chain_checked = False

    def _call(self, next_tensordict: TensorDictBase | None) -> TensorDictBase:
        name = type(self).__name__
        raise ValueError(
            f"{name} can only be applied to replay buffers, not to environments."
        )

    def get_extra_state(self) -> dict[str, Any]:
        """Returns the memory and the generator, for `state_dict` and `dumps`."""
        generator = self._generator
        with self._lock:
            return {
                "memory": self._memory.state(),
                "generator": None if generator is None else generator.get_state(),
            }

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Takes what `get_extra_state` returned."""
        with self._lock:
            self._memory.load(state["memory"])
            if state["generator"] is not None:
                self._generator = self._generator or torch.Generator("cpu")
                self._generator.set_state(state["generator"])

    def __getstate__(self) -> dict[str, Any]:
        state = super().__getstate__()
        del state["_lock"]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._lock = threading.Lock()


def calling_buffer() -> tuple[ReplayBuffer | None, str]:
    """Returns the replay buffer that calls a transform, and its method's name.

    torchrl gives transforms no handle on their buffer, and the data do not tell its
    size, layout, writer and sampler before it is too late. Costs 3 microseconds.
    """
    frame = inspect.currentframe()
    while frame is not None:
        caller = frame.f_locals.get("self")
        if issubclass(type(caller), ReplayBuffer):
            return caller, frame.f_code.co_name
        frame = frame.f_back
    return None, ""


def samples_slices(buffer: ReplayBuffer | None) -> bool:
    """Tells whether a buffer samples rows that follow each other in time."""
    return buffer is not None and (
        isinstance(buffer.sampler, SliceSampler)
        or isinstance(buffer._sample_unit, Sequence)
    )


def _has_multi_step(transform: Transform | None) -> bool:
    """Tells whether a MultiStepTransform is in the same chain, which may be nested."""
    while transform is not None:
        root, container = transform, transform.__dict__["_container"]
        transform = container() if container is not None else None
    return any(isinstance(t, MultiStepTransform) for t in root.modules())
