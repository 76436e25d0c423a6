"""Base class of the hindsight transforms: arguments, memory, checks, saving."""

import difflib
import gc
import inspect
import threading
import weakref
from collections.abc import Collection
from typing import Any

import numpy as np
import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torchrl import envs
from torchrl.data import ReplayBuffer
from typing_extensions import Self

from torch_panda.transforms.buffer import get_chain
from torch_panda.transforms.data_checks import (
    MULTI_STEP_ERROR,
    DataCheck,
    check_goals_agree,
    check_ids_differ,
    check_time_is_last,
)
from torch_panda.transforms.goal_memory import GoalMemory
from torch_panda.transforms.rewrite import DONE, GoalFunction, Rewriter
from torch_panda.transforms.strategies import (
    DESIRED,
    Integers,
    Mixture,
    StrategyOption,
)

SERIAL_KEY = "hindsight_serial"  # serial numbers of stored transitions
_NORMALISERS = (envs.ObservationNorm, envs.VecNorm, envs.VecNormV2)
ENVIRONMENT_ERROR = (
    "hindsight is for replay buffers, not for environments: pass the transform to the "
    "buffer"
)


class BufferTransform(envs.Transform):
    """A transform of a replay buffer that gives transitions other goals.

    It remembers the goals of the transitions that the buffer stores. It also checks the
    first batches for entries that were computed from the desired goal, because these
    would contradict another goal (see `data_checks`).

    Args:
        reward_fn: Maps (achieved_goal, desired_goal), (n, *goal) each, to the reward,
            (n, 1). Row i of the reward depends on row i of the goals only. The first
            stored rewards are checked against it.
        strategy: Name of a strategy, a function `(step, first, end, generator) -> goal
            step` (see `strategies`), or a mapping of these to weights.
        discount: Discount per step of the strategy "geometric".
        success_fn: Maps (achieved_goal, desired_goal) to the success, bool, (n, 1). If
            it is given, `success_key` is rewritten.
        terminated_fn: Maps (achieved_goal, desired_goal) to whether the episode
            terminates, bool, (n, 1), for tasks that end on success. If it is given,
            ("next", "terminated") and ("next", "done") are rewritten. Failures and
            truncations stay as they were.
        goal_key: Key of the desired goal, at the root and under "next".
        achieved_goal_key: Key of the achieved goal, at the root and under "next".
        reward_key: Key of the reward.
        success_key: Key of the success.
        trajectory_key: Key of the trajectory ids. Data without ids must have the batch
            shape [*environments, time].
        single_env: Whether data of one dimension and without ids are successive steps
            of one environment.
        seed: Seed of the transform's own random generator; None means torch's global
            generator.

    Raises:
        TypeError: An argument is unknown.
        ValueError: An argument has a value that is not accepted.
    """

    goal_parts: tuple[int, ...] | None = None
    _keeps_rows = True  # whether some rows keep their goal
    _shown: tuple[str, ...]  # names of the attributes in the repr

    def __init__(
        self,
        reward_fn: GoalFunction,
        *,
        strategy: StrategyOption = "future",
        discount: float = 0.99,
        success_fn: GoalFunction | None = None,
        terminated_fn: GoalFunction | None = None,
        goal_key: NestedKey = "desired_goal",
        achieved_goal_key: NestedKey = "achieved_goal",
        reward_key: NestedKey = ("next", "reward"),
        success_key: NestedKey = ("next", "success"),
        trajectory_key: NestedKey = ("collector", "traj_ids"),
        single_env: bool = False,
        seed: int | None = None,
        **unknown: Any,  # noqa: ANN401
    ) -> None:
        super().__init__()
        for name, value in unknown.items():
            raise TypeError(self._explain_unknown(name, value))
        if not callable(reward_fn):
            raise ValueError(f"reward_fn must be a function, got {reward_fn!r}")
        self.strategy, self.discount = strategy, discount
        self._mixture = Mixture.parse(strategy, discount)
        self.trajectory_key = unravel_key(trajectory_key)
        self.single_env = single_env
        keys = goal_key, achieved_goal_key, reward_key, success_key
        functions = reward_fn, success_fn, terminated_fn
        self._rewriter = Rewriter(*functions, *map(unravel_key, keys))
        ignored = "action", "collector", "index", SERIAL_KEY, self.trajectory_key
        warned: set[str] = set()
        self._check_written = DataCheck(self._rewriter, ignored, warned)
        # A second check, because other transforms may have added entries when sampling.
        self._check_sampled = DataCheck(self._rewriter, ignored, warned)
        self._memory = GoalMemory()
        self._generator: torch.Generator | None = None
        if seed is not None:
            self._generator = torch.Generator("cpu").manual_seed(seed)
        self._has_checked_setup = False
        self._lock = threading.Lock()  # a prefetching buffer samples in threads

    @classmethod
    def _explain_unknown(cls, name: str, value: Any) -> str:  # noqa: ANN401
        """Returns an error message for an unknown argument, naming the likely one."""
        accepted: list[str] = []
        for base in cls.__mro__[: cls.__mro__.index(BufferTransform) + 1]:
            names = inspect.signature(base).parameters
            accepted += [x for x in names if x not in ("options", "unknown")]
        if "strategies" in accepted:  # GoalSampler has a strategy per key
            accepted.remove("strategy")
        suggestion = None
        is_count = isinstance(value, int) and value > 0
        # Translate the arguments of the HER paper and of Stable-Baselines3.
        if name in ("k", "n_sampled_goal") and is_count and "her_ratio" in accepted:
            suggestion = f"her_ratio={value / (value + 1):.3g}"
        elif name == "goal_selection_strategy" and "strategies" in accepted:
            suggestion = "strategies"
        elif name == "goal_selection_strategy":
            suggestion = f"strategy={str(getattr(value, 'value', value)).lower()!r}"
        elif similar := difflib.get_close_matches(name, accepted, n=1):
            suggestion = similar[0]
        hint = f"use {suggestion}; " if suggestion else ""
        return (
            f"{cls.__name__} has no argument {name!r}; {hint}accepted are "
            f"{', '.join(dict.fromkeys(accepted))}"
        )

    @classmethod
    def from_env(cls, env: envs.EnvBase, **options: Any) -> Self:  # noqa: ANN401
        """Makes the transform with the goal functions of an environment.

        The environment's `compute_reward` becomes `reward_fn`, and its `is_success`
        becomes `success_fn`. If its attribute `terminate_on_success` is true,
        `is_success` also becomes `terminated_fn`. For a `ParallelEnv` or `SerialEnv`,
        one of its environments is created to read these functions, and then closed.

        Args:
            env: A `RobotTaskEnv` or another environment with these attributes. It may
                be wrapped in a `TransformedEnv`.
            **options: Arguments of the transform. They take precedence over the
                environment's functions.

        Raises:
            TypeError: An option is unknown.
            ValueError: The environment lacks a function that is not among the options,
                or the environment's transforms normalise a goal.
        """
        goal_keys = {
            unravel_key(options.get("goal_key", "desired_goal")),
            unravel_key(options.get("achieved_goal_key", "achieved_goal")),
        }
        while isinstance(env, envs.TransformedEnv):
            _refuse_normalised_goals(env.transform, goal_keys)
            env = env.base_env
        if isinstance(env, (envs.ParallelEnv, envs.SerialEnv)):
            worker = env.create_env_fn[0](**env.create_env_kwargs[0])
            try:
                return cls.from_env(worker, **options)
            finally:
                worker.close(raise_if_closed=False)
        attributes = {
            "reward_fn": "compute_reward",
            "success_fn": "is_success",
            "terminated_fn": "terminate_on_success",
        }
        for option, attribute in attributes.items():
            if option in options:
                continue
            value = getattr(env, attribute, None)
            if value is None:
                raise ValueError(f"{env} has no {attribute}: give {option}=...")
            if option == "terminated_fn":
                value = env.is_success if value else None
            options[option] = value
        transform = cls(**options)
        shapes = {
            key: spec.shape[env.ndim :]
            for key, spec in env.observation_spec.items(True, True)
        }
        for check in (transform._check_written, transform._check_sampled):
            check.shapes = shapes
        return transform

    def _remember(self, batch: TensorDictBase, stored: int) -> TensorDictBase:
        """Remembers transitions and tags them with their serial numbers.

        Args:
            batch: Transitions, [*environments, time].
            stored: Number of transitions in the buffer before this batch is written.
        """
        if not batch.shape.numel():
            return batch.set(SERIAL_KEY, torch.zeros(batch.shape, dtype=torch.int64))
        if not self._has_checked_setup:
            self._check_setup(batch)
            self._has_checked_setup = True
        rewriter, shape, flat = self._rewriter, batch.batch_size, batch
        keys = (
            rewriter.achieved_goal_key,
            rewriter.next_achieved_key,
            rewriter.goal_key,
            rewriter.next_goal_key,
            DONE,
        )
        if batch.ndim > 1:
            # Put time first, because a storage [environments, time] fills up along
            # time. Serial numbers then rise in the order in which rows are overwritten.
            flat = batch.select(self.trajectory_key, *keys, strict=False)
            flat = flat.movedim(-1, 0).reshape(-1)
        root_goal, achieved, desired, next_desired, done = (
            flat.get(key, None) for key in keys
        )
        if achieved is None or desired is None or next_desired is None or done is None:
            rewriter.check_entries(batch)  # raises
        if done.numel() != len(flat):
            raise ValueError(
                f"{DONE!r} must hold one value per transition, got {tuple(done.shape)} "
                f"in data of batch size {list(shape)}: if the transitions have further "
                "dimensions, add these to the batch size, such as [episodes, steps]"
            )
        self._check_written(batch, keeps_rows=self._keeps_rows)
        check_goals_agree(flat, rewriter)
        goals: Any = [achieved.numpy(force=True)]
        if self._draws_desired():
            goals.append(desired.numpy(force=True))
        root_goals = None if root_goal is None else root_goal.numpy(force=True)
        is_done = done.numpy(force=True).reshape(-1)
        ids = self._get_ids(flat, shape)
        serials = self._memory.write(ids, is_done, root_goals, goals, stored)
        tags = torch.from_numpy(serials)
        if batch.ndim > 1:
            tags = tags.view(shape[-1], *shape[:-1]).movedim(0, -1)
        return batch.set(SERIAL_KEY, tags.to(desired.device))

    def _get_mixtures(self) -> Collection[Mixture]:
        """Returns the mixtures of strategies from which goals are drawn."""
        return [self._mixture]

    def _draws_desired(self) -> bool:
        """Returns whether a strategy draws from the desired goals."""
        return any(DESIRED in mixture.weights for mixture in self._get_mixtures())

    def _claim(self, buffer: ReplayBuffer | None) -> None:
        """Binds the transform to the buffer.

        Raises:
            RuntimeError: The transform belongs to another buffer.
        """
        if buffer is None:
            return
        owner = self._memory.buffer
        if owner is not None and owner() is not buffer:
            if owner() is not None:
                gc.collect()  # frees the owner if only a reference cycle still holds it
            if owner() is not None:
                raise RuntimeError(
                    f"this {type(self).__name__} already belongs to another replay "
                    "buffer: make one transform for each buffer, or call empty() on "
                    "the transform to forget the other buffer's transitions"
                )
            self._forget()
        if owner is None or owner() is not buffer:
            self._memory.buffer = weakref.ref(buffer)

    def _find_mask(self, batch: TensorDictBase) -> torch.Tensor | None:
        """Returns which rows are real, (*batch,), or None if no row is padding.

        torchrl's `split_trajectories` pads trajectories and writes this mask next to
        the trajectory ids.
        """
        key = self.trajectory_key
        prefix = key[:-1] if isinstance(key, tuple) else ()
        mask = batch.get(unravel_key((*prefix, "mask")), None)
        if mask is None or mask.dtype != torch.bool or mask.shape != batch.shape:
            return None
        return None if mask.all() else mask

    def _check_setup(self, batch: TensorDictBase) -> None:
        """Checks that hindsight is possible with the buffer's transforms and its data.

        Raises:
            RuntimeError: The buffer has a `MultiStepTransform` or a second transform of
                this kind.
            KeyError: Entries are missing in the data.
            ValueError: The goals have a wrong type, or do not fit `goal_parts`; or data
                without trajectory ids are [time, num_envs]; or environments share
                trajectory ids.
        """
        chain = get_chain(self)
        if any(isinstance(t, envs.MultiStepTransform) for t in chain):
            raise RuntimeError(MULTI_STEP_ERROR)
        names = [type(t).__name__ for t in chain if isinstance(t, BufferTransform)]
        if len(names) > 1:
            raise RuntimeError(
                f"a buffer can have one hindsight transform, got {', '.join(names)}: "
                "keep one of them, or make a buffer for each"
            )
        self._rewriter.check_entries(batch)
        achieved = batch.get(self._rewriter.next_achieved_key)
        desired = batch.get(self._rewriter.goal_key)
        is_vector, size = achieved.ndim == batch.ndim + 1, achieved.shape[-1]
        parts = self.goal_parts
        if parts is not None and not (is_vector and sum(parts) == size):
            raise ValueError(
                f"goal_parts must add up to {size}, the size of the goal vector, got "
                f"{parts}"
            )
        if torch.bfloat16 in (achieved.dtype, desired.dtype):
            raise ValueError("hindsight cannot hold goals of bfloat16: use float32")
        ids = batch.get(self.trajectory_key, None)
        # torchrl's multi-process collectors first write a batch of zeros.
        if ids is not None and achieved.any():
            check_ids_differ(ids, batch.shape, self.trajectory_key)
        if ids is None and batch.ndim == 2:
            check_time_is_last(batch, self._rewriter)

    def _get_ids(self, flat: TensorDictBase, shape: torch.Size) -> Integers:
        """Returns the trajectory id of each row, (n,).

        If the data have no ids, each row gets the number of its environment.

        Args:
            flat: Transitions in order of time, (n,).
            shape: Batch shape before flattening, [*environments, time].
        """
        key, ids = self.trajectory_key, flat.get(self.trajectory_key, None)
        if ids is None:
            if len(shape) < 2 and not self.single_env:
                raise ValueError(
                    f"there are no trajectory ids at {key!r}, so the trajectory of a "
                    "row is unknown: keep the collector's ids, name other ids "
                    "(trajectory_key=...), extend with [num_envs, time], or pass "
                    "single_env=True for steps of one environment"
                )
            return np.arange(len(flat)) % shape[:-1].numel()
        if ids.numel() != len(flat):
            raise ValueError(
                f"{key!r} must hold one id per transition, got {tuple(ids.shape)} for "
                f"{tuple(shape)}"
            )
        return ids.numpy(force=True).reshape(-1)

    def __repr__(self) -> str:
        options = [f"{name}={getattr(self, name)!r}" for name in self._shown]
        return f"{type(self).__name__}({', '.join(options)})"

    def end_trajectories(self) -> None:
        """Ends all trajectories: the next row of each id begins a new trajectory."""
        with self._lock:
            self._memory.end_trajectories()

    def empty(self) -> None:
        """Forgets all transitions and the buffer. `buffer.empty()` does not do this."""
        with self._lock:
            self._forget()

    def _forget(self) -> None:
        self._memory, self._has_checked_setup = GoalMemory(), False

    def empty_cache(self) -> None:
        """Makes the next `extend` check the setup again.

        torchrl calls this method when the buffer's transforms change.
        """
        super().empty_cache()
        self._has_checked_setup = False

    def share_memory_(self) -> None:
        """Raises an error. torchrl calls this method if processes share the buffer."""
        raise RuntimeError(
            "hindsight has no share_memory_, because other processes cannot see its "
            "memory: do not pass the buffer to a multi-process collector "
            "(replay_buffer=...), but extend it with the batches that the collector "
            "yields"
        )

    def set_container(self, container: envs.Transform | envs.EnvBase) -> None:
        """Attaches this transform to a buffer. It cannot belong to an environment.

        Raises:
            ValueError: The container belongs to an environment.
        """
        # Only the transforms of an environment have a parent.
        if isinstance(container, envs.EnvBase) or container.parent is not None:
            raise ValueError(ENVIRONMENT_ERROR)
        super().set_container(container)
        self.empty_cache()

    def _call(self, next_tensordict: TensorDictBase | None) -> TensorDictBase:
        raise ValueError(ENVIRONMENT_ERROR)

    def get_extra_state(self) -> dict[str, Any]:
        """Returns the memory and the generator, for `state_dict` and `dumps`."""
        with self._lock:
            generator = self._generator
            random_state = None if generator is None else generator.get_state()
            return {"memory": self._memory.state(), "generator": random_state}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restores the state that `get_extra_state` returned.

        Raises:
            ValueError: A strategy draws from the desired goals, but the state lacks
                them.
        """
        with self._lock:
            self._memory.load(state["memory"], needs_desired=self._draws_desired())
            if state["generator"] is not None:
                self._generator = self._generator or torch.Generator("cpu")
                self._generator.set_state(state["generator"])

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in super().__getstate__().items() if k != "_lock"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__({**state, "_lock": threading.Lock()})


def _refuse_normalised_goals(
    transform: envs.Transform, goal_keys: set[NestedKey]
) -> None:
    """Raises a ValueError if an environment's transform normalises a goal in place."""
    for module in transform.modules():
        if isinstance(module, _NORMALISERS):
            normalised = goal_keys & set(map(unravel_key, module.out_keys))
            if normalised:
                raise ValueError(
                    f"{type(module).__name__} in the environment normalises "
                    f"{', '.join(map(repr, sorted(normalised, key=str)))}, but the "
                    "reward needs goals in their own units, not normalised: leave the "
                    "goals out of its in_keys, and normalise them in the buffer, after "
                    "this transform, or in the policy"
                )
