"""Hindsight: sampled transitions get goals that their trajectories achieved.

`Hindsight` remembers the transitions that a replay buffer stores, and draws goals when
the buffer is sampled. `HindsightRelabel` and `GoalSampler` write these goals.
"""

import inspect
import threading
import warnings
from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import Tensor
from torchrl import envs
from torchrl.data import ReplayBuffer, ReplayBufferEnsemble
from typing_extensions import Self

from torch_panda.transforms.checks import (
    DONE,
    MULTI_STEP_ERROR,
    TERMINATED,
    TRUNCATED,
    UNKNOWN_ROWS,
    DataCheck,
    Keys,
    check_entries,
    check_ids_differ,
    check_layout,
    check_time_is_last,
    find_buffer,
    get_chain,
    next_key,
    samples_slices,
)
from torch_panda.transforms.memory import SERIAL_KEY, Goals, TrajectoryMemory
from torch_panda.transforms.strategies import (
    Integers,
    Mixture,
    StrategyOption,
    draw_uniform,
)

# Maps (achieved_goal, desired_goal), (n, *goal) each, to values (n, 1).
GoalFunction = Callable[[Tensor, Tensor], Tensor]
Unit = Literal["row", "slice"]

_NORMALISERS = (envs.ObservationNorm, envs.VecNorm, envs.VecNormV2)
ENVIRONMENT_ERROR = (
    "hindsight is for replay buffers, not for environments: pass the transform to the "
    "buffer"
)


class Drawn(NamedTuple):
    """Goals that were drawn for m rows of a batch.

    Attributes:
        rows: Indices into the batch, (m,).
        goals: Goals of these rows, (m, *goal).
        sources: Serial numbers of the transitions that the goals come from, (m,).
    """

    rows: Integers
    goals: Goals
    sources: Integers


class Hindsight(envs.Transform):
    """Draws goals for the transitions that a replay buffer samples.

    On writing, it gives each transition a serial number, and remembers its trajectory
    and its goals under this number. On sampling, the serial numbers say where the
    sampled rows are in their trajectories, and a goal is drawn for each of them. The
    subclasses write the goals.

    Args:
        reward_fn: Maps (achieved_goal, desired_goal), (n, *goal) each, to the reward,
            (n, 1). Row i of the reward depends on row i of the goals only. The first
            stored rewards are checked against it.
        mixtures: Strategies that draw the goals of each key.
        her_ratio: Fraction of the rows that get a drawn goal. None means all rows.
        unit: See `HindsightRelabel`, as for all further arguments.

    Raises:
        ValueError: An argument has a value that is not accepted.
    """

    goal_parts: tuple[int, ...] | None = None
    _shown: tuple[str, ...]  # names of the attributes in the repr

    def __init__(
        self,
        reward_fn: GoalFunction,
        mixtures: Mapping[NestedKey, Mixture],
        her_ratio: float | None,
        *,
        unit: Unit,
        success_fn: GoalFunction | None,
        terminated_fn: GoalFunction | None,
        keys: Keys,
        single_env: bool,
        capacity: int | None,
        seed: int | None,
    ) -> None:
        super().__init__()
        if not callable(reward_fn):
            raise ValueError(f"reward_fn must be a function, got {reward_fn!r}")
        if unit not in ("row", "slice"):
            raise ValueError(f'unit must be "row" or "slice", got {unit!r}')
        if capacity is not None and (capacity < 1 or not float(capacity).is_integer()):
            raise ValueError(f"capacity must be a positive integer, got {capacity}")
        self.her_ratio, self.unit, self.single_env = her_ratio, unit, single_env
        self.capacity = None if capacity is None else int(capacity)
        self._mixtures, self._keys = mixtures, keys
        # A dictionary, so that torch does not register a learned reward as a part of
        # this module.
        self._functions = {keys.reward: reward_fn}
        if success_fn is not None:
            self._functions[keys.success] = success_fn
        if terminated_fn is not None:
            self._functions[TERMINATED] = terminated_fn
        ignored = "action", "collector", "index", SERIAL_KEY, keys.trajectory
        self._data_check = DataCheck(keys, ignored)
        self._generator: torch.Generator | None = None
        if seed is not None:
            self._generator = torch.Generator("cpu").manual_seed(seed)
        self._lock = threading.Lock()  # a prefetching buffer samples in threads
        self._forget()

    def _forget(self) -> None:
        self._memory = TrajectoryMemory(
            self._keys, single_env=self.single_env, capacity=self.capacity
        )
        self._has_checked_setup = self._has_sampled = False
        self._data_check.restart()

    @classmethod
    def from_env(cls, env: envs.EnvBase, *args: Any, **options: Any) -> Self:  # noqa: ANN401
        """Makes the transform with the goal functions of an environment.

        The environment's `compute_reward` becomes `reward_fn`, and its `is_success`
        becomes `success_fn`. If its attribute `terminate_on_success` is true,
        `is_success` also becomes `terminated_fn`. For a `ParallelEnv` or `SerialEnv`,
        one of its environments is created to read these functions, and then closed.

        Args:
            env: A `RobotTaskEnv` or another environment with these attributes. It may
                be wrapped in a `TransformedEnv`.
            *args: Strategies of `GoalSampler`.
            **options: Arguments of the transform. They take precedence over the
                environment's functions.

        Raises:
            TypeError: An option is unknown.
            ValueError: The environment lacks a function that is not among the options,
                or the environment's transforms normalise a goal.
        """
        # Translate arguments of the HER paper and of Stable-Baselines3.
        accepted = inspect.signature(cls).parameters
        for name in options:
            if name not in accepted:
                hint = ""
                if name in ("k", "n_sampled_goal") and "her_ratio" in accepted:
                    hint = f"use her_ratio={options[name] / (options[name] + 1):.3g}; "
                elif name == "goal_selection_strategy" and "strategy" in accepted:
                    hint = "use strategy; "
                raise TypeError(
                    f"{cls.__name__} has no argument {name!r}; {hint}accepted are "
                    f"{', '.join(accepted)}"
                )
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
                return cls.from_env(worker, *args, **options)
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
        transform = cls(*args, **options)
        transform._data_check.shapes = {
            key: spec.shape[env.ndim :]
            for key, spec in env.observation_spec.items(True, True)
        }
        return transform

    # -- writing ----------------------------------------------------------------------

    @torch.compiler.disable  # a compiled loop may write too; see `forward`
    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Remembers transitions that are about to be stored, and numbers them."""
        buffer, method = find_buffer()
        mask = self._find_mask(tensordict)
        is_one_item = not tensordict.ndim
        if buffer is not None:
            check_layout(buffer, method, tensordict, is_padded=mask is not None)
            is_one_item = tensordict.ndim < buffer.storage.ndim
        batch: TensorDictBase = tensordict
        if mask is not None:
            batch = tensordict[mask]  # type: ignore[assignment]  # a TensorDict
        if is_one_item:
            batch = batch.unsqueeze(-1)
        if not batch.shape.numel():
            return batch.set(SERIAL_KEY, torch.zeros(batch.shape, dtype=torch.int64))
        with self._lock:
            self._check_setup(batch)
            batch = self._memory.remember(batch, buffer)
        return batch.squeeze(-1) if is_one_item else batch

    def _find_mask(self, batch: TensorDictBase) -> Tensor | None:
        """Returns which rows are real, (*batch,), or None if no row is padding.

        torchrl's `split_trajectories` pads trajectories and writes this mask next to
        the trajectory ids.
        """
        key = self._keys.trajectory
        prefix = key[:-1] if isinstance(key, tuple) else ()
        mask = batch.get(unravel_key((*prefix, "mask")), None)
        if mask is None or mask.dtype != torch.bool or mask.shape != batch.shape:
            return None
        return None if mask.all() else mask

    def _check_setup(self, batch: TensorDictBase) -> None:
        """Checks the buffer's transforms and its data before the first write.

        Raises:
            RuntimeError: The buffer has a `MultiStepTransform` or a second transform of
                this kind.
            KeyError: Entries are missing in the data.
            ValueError: The goals have a wrong type, or do not fit `goal_parts`; or data
                without trajectory ids are [time, num_envs]; or environments share
                trajectory ids.
        """
        if self._has_checked_setup:
            return
        chain, keys = get_chain(self), self._keys
        if any(isinstance(t, envs.MultiStepTransform) for t in chain):
            raise RuntimeError(MULTI_STEP_ERROR)
        names = [type(t).__name__ for t in chain if isinstance(t, Hindsight)]
        if len(names) > 1:
            raise RuntimeError(
                f"a buffer can have one hindsight transform, got {', '.join(names)}: "
                "keep one of them, or make a buffer for each"
            )
        check_entries(batch, (*keys.remembered, *self._functions))
        achieved, desired = batch.get(keys.next_achieved_goal), batch.get(keys.goal)
        is_vector, size = achieved.ndim == batch.ndim + 1, achieved.shape[-1]
        parts = self.goal_parts
        if parts is not None and not (is_vector and sum(parts) == size):
            raise ValueError(
                f"goal_parts must add up to {size}, the size of the goal vector, got "
                f"{parts}"
            )
        if torch.bfloat16 in (achieved.dtype, desired.dtype):
            raise ValueError("hindsight cannot hold goals of bfloat16: use float32")
        ids = batch.get(keys.trajectory, None)
        # torchrl's multi-process collectors first write a batch of zeros.
        if ids is not None and achieved.any():
            check_ids_differ(ids, batch.shape, keys.trajectory)
        if ids is None and batch.ndim == 2:
            check_time_is_last(batch, keys)
        self._has_checked_setup = True

    def prepare(self, data: TensorDictBase) -> TensorDictBase:
        """Remembers stored transitions, such as those of a data set.

        Args:
            data: Transitions with trajectory ids, or of batch shape [trajectories,
                time].

        Returns:
            The transitions in one dimension, with serial numbers. Put them into the
            `TensorStorage` of a buffer with this transform. The tensors are not copied.

        Raises:
            RuntimeError: The transform has remembered other transitions before.
            ValueError: There are no transitions, or most of them are not in the order
                of time.
        """
        if not data.shape.numel():
            raise ValueError(f"there are no transitions in data {list(data.shape)}")
        if self._memory.count:
            raise RuntimeError(
                "prepare() must come before any extend(): make a new transform, or "
                "call empty() first"
            )
        flat = data.reshape(-1)
        identified = flat.copy()
        if data.ndim > 1 and data.get(self._keys.trajectory, None) is None:
            ids = torch.arange(len(flat), device="cpu") // data.shape[-1]
            identified.set(self._keys.trajectory, ids)
        mask = self._find_mask(data)
        if mask is not None:
            flat, identified = flat[mask.reshape(-1)], identified[mask.reshape(-1)]
        with self._lock:
            self._check_setup(identified)
            tags = self._memory.remember(identified, None).get(SERIAL_KEY)
            is_shuffled = self._memory.is_shuffled(identified)
            self._memory.end_trajectories()
            if is_shuffled:
                self._forget()
                raise ValueError(
                    f"the {self._keys.achieved_goal!r} of most transitions is not the "
                    "goal that the transition before them with the same id achieved: "
                    "pass whole trajectories in the order of time, not shuffled rows"
                )
        return flat.copy().set(SERIAL_KEY, tags)

    # -- sampling ---------------------------------------------------------------------

    # A compiled loss may sample. `torch.compile` cannot trace numpy code whose sizes
    # vary from batch to batch, so break the graph here. This also keeps the call stack
    # that `find_buffer` reads.
    @torch.compiler.disable
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Gives sampled transitions other goals."""
        buffer, method = find_buffer()
        batch = tensordict.reshape(-1)
        # The buffer's `_sample` returns a copy, which may be changed in place. Other
        # methods of the buffer may return the storage itself, or a lazy stack.
        if method != "_sample" or type(tensordict) is not TensorDict:
            batch = batch.to_tensordict()
        tags = batch.get(SERIAL_KEY, None)
        if tags is None:
            raise RuntimeError(UNKNOWN_ROWS)
        serials = tags.numpy(force=True)
        with self._lock:
            self._check_batch(batch, serials, buffer)
            drawn = {
                key: self._draw(batch, serials, mixture)
                for key, mixture in self._mixtures.items()
            }
        self._write(batch, drawn)
        return batch.del_(SERIAL_KEY).reshape(tensordict.shape)

    def _check_batch(
        self, batch: TensorDictBase, serials: Integers, buffer: ReplayBuffer | None
    ) -> None:
        """Checks sampled rows before they are relabelled.

        Raises:
            RuntimeError: Most rows achieved another goal than the transitions that are
                remembered under their serial numbers.
            KeyError, ValueError: The data do not suit hindsight.
        """
        memory, keys = self._memory, self._keys
        if memory.count == memory.oldest:
            raise RuntimeError(UNKNOWN_ROWS)
        is_first, self._has_sampled = not self._has_sampled, True
        if is_first:
            check_entries(batch, (*keys.remembered, *self._functions))
            if self.unit == "row" and samples_slices(buffer):
                warnings.warn(
                    'each row of a slice gets a goal of its own: pass unit="slice" for '
                    "one goal per slice",
                    stacklevel=2,
                )
            sampler = getattr(buffer, "sampler", None)
            overwrites_ends = getattr(sampler, "truncated_key", None) is not None
            if TERMINATED in self._functions and overwrites_ends:
                raise ValueError(
                    "the sampler overwrites terminated and done of relabelled rows: "
                    "pass it truncated_key=None"
                )
        # One buffer of an ensemble may hold rows of another transform.
        if is_first or isinstance(buffer, ReplayBufferEnsemble):
            achieved = batch.get(keys.next_achieved_goal)
            remembered = torch.from_numpy(memory.get_goals(serials)).to(achieved)
            differs = ((achieved != remembered) & ~achieved.isnan()).flatten(1).any(1)
            # Another thread may have overwritten rows since they were sampled.
            if differs.sum() > len(batch) / 2 and (serials >= memory.oldest).all():
                raise RuntimeError(
                    "the sampled rows are not the transitions that this transform "
                    "remembers: sample them with the transform through which they were "
                    "stored, or pass all of them through this one"
                )
        if not self._data_check.is_finished:
            rows = torch.arange(len(batch), device=batch.get(keys.goal).device)
            expected = self._evaluate(batch, rows, batch.get(keys.goal))
            self._data_check(
                batch, expected, keeps_rows=self.her_ratio not in (None, 1)
            )

    def _draw(
        self, batch: TensorDictBase, serials: Integers, mixture: Mixture
    ) -> Drawn:
        """Draws which rows get another goal, and their goals.

        A unit (a row or a slice) gets one goal, which is drawn for its last row. So a
        future goal is achieved in this row or later.
        """
        memory, generator = self._memory, self._generator
        last_serials, units = self._find_units(serials)
        is_chosen = np.ones(len(last_serials), np.bool_)
        if self.her_ratio is not None:
            is_chosen = draw_uniform(len(last_serials), generator) < self.her_ratio
        # A row that another thread has overwritten since it was sampled keeps its goal,
        # and so does its slice.
        is_forgotten = serials < memory.oldest
        is_chosen[is_forgotten if units is None else units[is_forgotten]] = False
        chosen_units = is_chosen.nonzero()[0]
        sources, goals = memory.draw(last_serials[chosen_units], mixture, generator)
        if units is None:
            return Drawn(chosen_units, goals, sources)
        rows = is_chosen[units].nonzero()[0]
        # The goal of the chosen unit i is goals[goal_index[i]].
        goal_index = (is_chosen.cumsum() - 1)[units[rows]]
        return Drawn(rows, goals[goal_index], sources[goal_index])

    def _find_units(self, serials: Integers) -> tuple[Integers, Integers | None]:
        """Groups rows into units, which are rows or slices.

        Returns:
            Serial number of the last row of each unit, (m,). Index of each row's unit,
            (n,), or None if each row is a unit.
        """
        if self.unit == "row":
            return serials, None
        numbers, steps = self._memory.find(serials)
        # A slice continues with the next step, or with the same one where a sampler
        # repeats it to pad a short slice.
        continues = (np.diff(numbers) == 0) & np.isin(np.diff(steps), (0, 1))
        is_last = np.append(~continues, True)
        return serials[is_last], is_last.cumsum() - is_last

    @abstractmethod
    def _write(self, batch: TensorDictBase, drawn: dict[NestedKey, Drawn]) -> None:
        """Writes what `_draw` returned for each key into a batch (n,)."""

    def _evaluate(
        self, batch: TensorDictBase, rows: Tensor, goals: Tensor
    ) -> dict[NestedKey, Tensor]:
        """Computes reward, success and ends of transitions with other goals.

        Args:
            batch: Transitions, (m,).
            rows: Indices into the batch, (n,).
            goals: Goals of these rows, (n, *goal).

        Returns:
            New values by key, (n, 1) each: the reward and, if there are functions for
            them, the success and the ends.
        """
        achieved = batch.get(self._keys.next_achieved_goal).index_select(0, rows)
        values = {
            key: call_goal_function(function, achieved, goals, batch.get(key))
            for key, function in self._functions.items()
        }
        if TERMINATED in values:
            done, terminated = batch.get(DONE), batch.get(TERMINATED)
            # torchrl's ReplayBufferTrainer sets "truncated" in every row, probably by
            # mistake. "done" is true only where an episode ends, so a row counts as
            # truncated only if both are true. In data without "truncated", it counts if
            # it is done but not terminated.
            truncated = batch.get(TRUNCATED, ~terminated) & done
            # An episode that terminated without reaching its goal has failed. With
            # another goal it would fail too, so it stays terminated.
            has_failed = terminated.index_select(0, rows)
            if has_failed.any():
                stored_goals = batch.get(self._keys.goal).index_select(0, rows)
                has_failed &= ~call_goal_function(
                    self._functions[TERMINATED], achieved, stored_goals, terminated
                )
            values[TERMINATED] = has_failed | values[TERMINATED]
            values[DONE] = values[TERMINATED] | truncated.index_select(0, rows)
        return values

    # -- torchrl's interface ----------------------------------------------------------

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

    def get_extra_state(self) -> dict[str, Any]:
        """Returns the memory and the generator, for `state_dict` and `dumps`."""
        with self._lock:
            generator = self._generator
            random_state = None if generator is None else generator.get_state()
            return {"memory": self._memory.state(), "generator": random_state}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restores the state that `get_extra_state` returned."""
        with self._lock:
            self._forget()
            self._memory.load(state["memory"])
            if state["generator"] is not None:
                self._generator = self._generator or torch.Generator("cpu")
                self._generator.set_state(state["generator"])

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_lock": None}  # it cannot be pickled

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__({**state, "_lock": threading.Lock()})


class HindsightRelabel(Hindsight):
    """Gives sampled transitions hindsight goals.

    Hindsight experience replay (Andrychowicz et al. 2017, arXiv 1707.01495): a random
    fraction `her_ratio` of the sampled rows gets another goal, with the reward of that
    goal. The other rows stay as they were stored. README.md in this folder is a guide.

    The option `strategy` says where a new goal comes from:

    - "future" (default): achieved at this step of the trajectory or later;
    - "geometric": the same, but near steps are more likely;
    - "current": achieved at this step;
    - "final": achieved at the last step of the trajectory;
    - "episode": achieved at any step of the trajectory;
    - "random": achieved by any stored transition;
    - "desired": the desired goal of any stored transition.

    Args:
        reward_fn: Maps (achieved_goal, desired_goal), (n, *goal) each, to the reward,
            (n, 1). Row i of the reward depends on row i of the goals only. The first
            stored rewards are checked against it.
        her_ratio: Fraction of the rows to relabel. The paper's k hindsight goals per
            transition correspond to k / (k + 1).
        strategy: Name of a strategy, a function `(step, first, end, generator) -> goal
            step` (see `strategies`), or a mapping of these to weights.
        discount: Discount per step of the strategy "geometric".
        goal_parts: Sizes of the parts of a goal vector, such as (3, 3). Each part is
            relabelled on its own, with probability `her_ratio` (Lanier et al. 2019,
            arXiv 1906.03710).
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
            shape [*environments, time]. If there is an entry "mask" of the same
            nesting, of one bool per row, the rows where it is false are padding and
            dropped (torchrl's `split_trajectories` writes this entry).
        single_env: Whether data of one dimension and without ids are successive steps
            of one environment.
        unit: Rows that share a goal. "row" draws a goal for each row. "slice" draws one
            goal for all rows of a sampled slice. It is drawn for the last of these
            rows, so that a "future" goal lies in the future of all of them. If the
            buffer has a `SliceSampler`, make the sampler with `truncated_key=None`.
            Otherwise it overwrites "terminated", "truncated" and "done" of relabelled
            rows.
        capacity: Number of transitions to remember, for a transform that is called
            without a buffer. None remembers all. (In a buffer, the transform remembers
            as many as the buffer holds.)
        seed: Seed of the transform's own random generator; None means torch's global
            generator.

    Raises:
        ValueError: An argument has a value that is not accepted.
    """

    _shown = ("strategy", "her_ratio", "unit", "goal_parts")

    def __init__(
        self,
        reward_fn: GoalFunction,
        *,
        her_ratio: float = 0.8,
        strategy: StrategyOption = "future",
        discount: float = 0.99,
        goal_parts: tuple[int, ...] | None = None,
        success_fn: GoalFunction | None = None,
        terminated_fn: GoalFunction | None = None,
        goal_key: NestedKey = "desired_goal",
        achieved_goal_key: NestedKey = "achieved_goal",
        reward_key: NestedKey = ("next", "reward"),
        success_key: NestedKey = ("next", "success"),
        trajectory_key: NestedKey = ("collector", "traj_ids"),
        single_env: bool = False,
        unit: Unit = "row",
        capacity: int | None = None,
        seed: int | None = None,
    ) -> None:
        if not 0 <= her_ratio <= 1:
            raise ValueError(f"her_ratio must be within [0, 1], got {her_ratio}")
        if goal_parts is not None and (not goal_parts or min(goal_parts) < 1):
            raise ValueError(f"goal_parts must be positive sizes, got {goal_parts!r}")
        keys = Keys(
            goal_key, achieved_goal_key, reward_key, success_key, trajectory_key
        )
        super().__init__(
            reward_fn,
            {keys.goal: Mixture.parse(strategy, discount)},
            her_ratio,
            unit=unit,
            success_fn=success_fn,
            terminated_fn=terminated_fn,
            keys=keys,
            single_env=single_env,
            capacity=capacity,
            seed=seed,
        )
        self.strategy, self.discount, self.goal_parts = strategy, discount, goal_parts

    def _draw(
        self, batch: TensorDictBase, serials: Integers, mixture: Mixture
    ) -> Drawn:
        if self.goal_parts is None:
            return super()._draw(batch, serials, mixture)
        goals = batch.get(self._keys.goal).numpy(force=True).copy()
        is_relabelled = np.zeros(len(goals), dtype=bool)
        for end, size in zip(np.cumsum(self.goal_parts), self.goal_parts, strict=True):
            part = slice(end - size, end)
            rows, drawn, _ = super()._draw(batch, serials, mixture)
            goals[rows, part] = drawn[:, part]
            is_relabelled[rows] = True
        rows = is_relabelled.nonzero()[0]
        return Drawn(rows, goals[rows], serials[rows])

    def _write(self, batch: TensorDictBase, drawn: dict[NestedKey, Drawn]) -> None:
        (relabelled,) = drawn.values()
        if not len(relabelled.rows):
            return
        stored = batch.get(self._keys.goal)
        rows = torch.from_numpy(relabelled.rows).to(stored.device)
        goals = torch.from_numpy(relabelled.goals).to(stored)
        values = self._evaluate(batch, rows, goals)
        values |= {self._keys.goal: goals, self._keys.next_goal: goals}
        for key, new in values.items():
            batch.get(key).index_copy_(0, rows, new)


class GoalSampler(Hindsight):
    """Adds several goals to sampled transitions, each with its own strategy.

    Offline goal-conditioned algorithms draw different goals for the value function and
    for the policy (OGBench, Park et al. 2025, arXiv 2410.20092):

        GoalSampler(
            {
                "value_goal": {"current": 0.2, "geometric": 0.5, "random": 0.3},
                "actor_goal": "future",
            },
            reward_fn=compute_reward,
        )

    Every row gets a goal under each key, (n, *goal), and the same goal under "next".
    The goals of the first key determine the reward of all rows. They also determine
    success, "terminated" and "done", if `success_fn` and `terminated_fn` are given. The
    desired goals stay as stored, unless `goal_key` is one of the keys.

    The row from which a goal comes is returned too, (n,): for "value_goal" under
    "value_goal_row". Rows are numbered in the order of writing. So these numbers are
    indices into data that went through `prepare`.

    Args:
        strategies: For each key, a strategy as in `HindsightRelabel`: a name, a
            function, or a mapping of these to weights.
        reward_fn: Maps (achieved_goal, desired_goal), (n, *goal) each, to the reward,
            (n, 1).
        discount: Discount per step of the strategy "geometric".
        success_fn: See `HindsightRelabel`, as for all further arguments.

    Raises:
        ValueError: An argument has a value that is not accepted.
    """

    _shown = ("strategies", "discount", "unit")

    def __init__(
        self,
        strategies: Mapping[Any, StrategyOption],
        reward_fn: GoalFunction,
        *,
        discount: float = 0.99,
        success_fn: GoalFunction | None = None,
        terminated_fn: GoalFunction | None = None,
        goal_key: NestedKey = "desired_goal",
        achieved_goal_key: NestedKey = "achieved_goal",
        reward_key: NestedKey = ("next", "reward"),
        success_key: NestedKey = ("next", "success"),
        trajectory_key: NestedKey = ("collector", "traj_ids"),
        single_env: bool = False,
        unit: Unit = "row",
        capacity: int | None = None,
        seed: int | None = None,
    ) -> None:
        if not isinstance(strategies, Mapping) or not strategies:
            raise ValueError(
                "strategies must map keys of new entries to strategies, such as "
                f'{{"value_goal": "geometric"}}, got {strategies!r}'
            )
        keys = Keys(
            goal_key, achieved_goal_key, reward_key, success_key, trajectory_key
        )
        mixtures: dict[NestedKey, Mixture] = {
            unravel_key(key): Mixture.parse(strategy, discount)
            for key, strategy in strategies.items()
        }
        if keys.achieved_goal in mixtures:
            raise ValueError(
                f"strategies must not replace {keys.achieved_goal!r}: name a new entry"
            )
        super().__init__(
            reward_fn,
            mixtures,
            None,
            unit=unit,
            success_fn=success_fn,
            terminated_fn=terminated_fn,
            keys=keys,
            single_env=single_env,
            capacity=capacity,
            seed=seed,
        )
        self.strategies, self.discount = {**strategies}, discount

    def _check_setup(self, batch: TensorDictBase) -> None:
        """Also checks that the new entries replace no entries of the data.

        Raises:
            ValueError: The data have an entry under one of the keys.
        """
        super()._check_setup(batch)
        for key in self._mixtures:
            places = key, next_key(key)
            if key != self._keys.goal and any(
                batch.get(place, None) is not None for place in places
            ):
                raise ValueError(
                    f"strategies must not replace {key!r}, which the data have "
                    "already: name a new entry"
                )

    def _write(self, batch: TensorDictBase, drawn: dict[NestedKey, Drawn]) -> None:
        stored_goals = batch.get(self._keys.goal)
        # Rows that another thread has overwritten get the goals that they achieved.
        achieved = batch.get(self._keys.next_achieved_goal).to(stored_goals)
        values: dict[NestedKey, Tensor] = {}
        for key, (rows, goals, sources) in drawn.items():
            index = torch.from_numpy(rows).to(achieved.device)
            new = torch.from_numpy(goals).to(achieved)
            goal = achieved.index_copy(0, index, new)
            row = batch.get(SERIAL_KEY).index_copy(
                0, index, torch.from_numpy(sources).to(index)
            )
            if not values:  # the first key
                every_row = torch.arange(len(batch), device=achieved.device)
                values = self._evaluate(batch, every_row, goal)
            prefix, name = (key[:-1], key[-1]) if isinstance(key, tuple) else ((), key)
            values |= {key: goal, next_key(key): goal.clone()}
            values[unravel_key((*prefix, f"{name}_row"))] = row
        for key, new in values.items():
            batch.set(key, new)


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


def call_goal_function(
    function: GoalFunction, achieved: Tensor, desired: Tensor, stored: Tensor
) -> Tensor:
    """Calls a goal function and returns its values in the type of the stored entry.

    Args:
        function: `reward_fn`, `success_fn` or `terminated_fn`.
        achieved: Achieved goals, (n, *goal).
        desired: Desired goals, (n, *goal).
        stored: The entry that the values belong to, (m, 1).

    Raises:
        ValueError: The function did not return a tensor (n, 1).
    """
    with torch.no_grad():  # the function may be a learned network
        values = function(achieved, desired)
    expected_shape = (len(achieved), *stored.shape[1:])
    is_tensor = isinstance(values, Tensor)
    result = tuple(values.shape) if is_tensor else type(values).__name__
    if result != expected_shape:
        raise ValueError(
            "reward_fn, success_fn and terminated_fn must map (achieved_goal, "
            f"desired_goal), (n, *goal) each, to a tensor (n, 1): {function} should "
            f"return shape {expected_shape}, got {result}"
        )
    return values.to(stored.dtype)
