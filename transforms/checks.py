"""Checks of buffers and data that hindsight would relabel wrongly.

A relabelled transition gets another goal and the reward of that goal. All other entries
stay as they were stored. If one of them was computed from the old goal, for instance a
concatenation of observation and goal, the transition then contains two goals.
"""

import inspect
import warnings
from dataclasses import dataclass, fields

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import ReplayBuffer, RoundRobinWriter, SliceSampler
from torchrl.data.replay_buffers.sample_units import Sequence
from torchrl.envs import EnvBase, Transform

DONE, TERMINATED, TRUNCATED = (
    ("next", name) for name in ("done", "terminated", "truncated")
)

MAX_BATCH_ROWS = 128  # rows of one batch that are checked
MAX_POOL_ROWS = 512  # rows that are checked together
MIN_CHECKS = 10  # checks before `DataCheck` may finish
MAX_TOTAL_ROWS = 100_000  # `DataCheck` finishes after this number of rows
# An entry may equal one goal by chance. It counts as a copy only if it equals several
# different goals, and the number of these goals times goal_dim is at least this.
MIN_GOAL_NUMBERS = 6

MULTI_STEP_ERROR = (
    "rewards of several steps (MultiStep, MultiStepTransform) cannot be recomputed for "
    "other goals: store one step per row, and sample slices with "
    'HindsightRelabel(unit="slice")'
)
UNKNOWN_ROWS = (
    "rows of the buffer did not pass through this transform when they were stored: put "
    "the transform into the buffer before the first extend(), put transforms that "
    "select or exclude entries after it, and pass rows that are stored already through "
    "prepare(); only one thread may write to the buffer"
)
FIX = "compute it in the buffer, after this transform (append_transform)"


@dataclass
class Keys:
    """Keys of the entries that hindsight reads and rewrites, in their shortest form.

    Attributes:
        goal: Desired goal, at the root and under "next".
        achieved_goal: Achieved goal, at the root and under "next".
        reward: Reward.
        success: Success.
        trajectory: Trajectory ids.
        next_goal: Desired goal under "next".
        next_achieved_goal: Achieved goal under "next".
        remembered: Entries that every transition must have.
    """

    goal: NestedKey
    achieved_goal: NestedKey
    reward: NestedKey
    success: NestedKey
    trajectory: NestedKey

    def __post_init__(self) -> None:
        """Shortens the keys, and adds those under "next"."""
        for key in fields(self):
            setattr(self, key.name, unravel_key(getattr(self, key.name)))
        self.next_goal = next_key(self.goal)
        self.next_achieved_goal = next_key(self.achieved_goal)
        self.remembered = self.next_achieved_goal, self.goal, self.next_goal, DONE


def next_key(key: NestedKey) -> NestedKey:
    """Returns the key of an entry under "next"."""
    return unravel_key(("next", key))


def find_buffer() -> tuple[ReplayBuffer | None, str]:
    """Finds the replay buffer that is calling the transform, and the calling method.

    torchrl gives a transform no reference to its buffer. But hindsight depends on the
    buffer's size, storage, writer and sampler. So this function walks up the call stack
    (3 us) to the innermost function of `torchrl.data` whose `self` is a buffer.

    Returns:
        The buffer and the name of its method, such as "extend". If no buffer is
        calling, as in `transform.forward(batch)`: None and "".

    Raises:
        RuntimeError: The buffer replaces stored rows (`rb[i] = ...`).
    """
    frame = inspect.currentframe()
    while frame is not None:
        if frame.f_globals.get("__name__", "").startswith("torchrl.data."):
            buffer = frame.f_locals.get("self")
            if isinstance(buffer, ReplayBuffer):
                method = frame.f_code.co_name
                if method == "__setitem__":
                    raise RuntimeError(
                        "hindsight does not support replacing rows (rb[i] = ...): use "
                        "extend()"
                    )
                return buffer, method
        frame = frame.f_back
    return None, ""


def samples_slices(buffer: ReplayBuffer | None) -> bool:
    """Returns whether the buffer samples slices of trajectories."""
    sampler, unit = getattr(buffer, "sampler", None), getattr(buffer, "_sample_unit", 0)
    return isinstance(sampler, SliceSampler) or isinstance(unit, Sequence)


def get_chain(transform: Transform) -> list[Transform | EnvBase]:
    """Returns all transforms of a transform's buffer, in order.

    The transforms may be nested in several `Compose`.
    """
    root: Transform | EnvBase = transform
    while (container := root.__dict__["_container"]) and container():
        root = container()
    return [module for module in root.modules() if isinstance(module, Transform)]


def check_layout(
    buffer: ReplayBuffer, method: str, data: TensorDictBase, *, is_padded: bool
) -> None:
    """Checks that the buffer writes these transitions in order of time.

    Args:
        buffer: The buffer.
        method: Method of the buffer that is writing: "add" or "extend".
        data: The transitions.
        is_padded: Whether some rows are padding.

    Raises:
        RuntimeError: The buffer would write them in another order, or the data have
            padding that cannot be removed.
    """
    ndim, writer = buffer.storage.ndim, type(buffer.writer)
    if is_padded and not ndim == data.ndim == 1:
        raise RuntimeError(
            "padded rows (split_trajs=True) can only be removed from data [time] for a "
            f"storage of ndim=1, got data {list(data.shape)} and ndim={ndim}: extend a "
            "storage of ndim=1 with data.reshape(-1), or do not split trajectories"
        )
    if not issubclass(writer, RoundRobinWriter):
        raise RuntimeError(
            "the writer must be round-robin, so that rows are in order of time, got "
            f"{writer.__name__}: make the buffer without writer="
        )
    if buffer.dim_extend != ndim - 1:
        raise RuntimeError(
            "the last dimension of a storage must be time, got dim_extend="
            f"{buffer.dim_extend} for ndim={ndim}: make the buffer without dim_extend="
        )
    if data.ndim != ndim and (method != "add" or data.ndim != ndim - 1):
        raise RuntimeError(
            f"data {list(data.shape)} for ndim={ndim} must have as many dimensions as "
            "the storage: call extend(data.reshape(-1)) with ndim=1, or use ndim=2 for "
            "data [num_envs, time], such as those of a collector with replay_buffer="
        )
    if method == "add" and data.shape[ndim - 1 :].numel() > 1:
        raise RuntimeError(
            f"add() writes a single step, got data {list(data.shape)} for ndim={ndim}: "
            "call extend(); a collector with replay_buffer= needs ndim=2 and "
            "extend_buffer=True"
        )


def check_entries(batch: TensorDictBase, needed: tuple[NestedKey, ...]) -> None:
    """Checks that the batch has all entries that hindsight reads or rewrites.

    Raises:
        KeyError: Entries are missing.
    """
    missing = [key for key in needed if batch.get(key, None) is None]
    if missing:
        raise KeyError(
            f"hindsight needs {missing} in the data, which has "
            f"{sorted(map(str, batch.keys(True, True)))}; if the data hold no success, "
            "pass success_fn=None"
        )


def check_goals_agree(batch: TensorDictBase, keys: Keys) -> None:
    """Checks that every transition has the same desired goal before and after it.

    Raises:
        ValueError: The two goals of a transition differ.
    """
    goals, next_goals = batch.get(keys.goal), batch.get(keys.next_goal)
    if torch.equal(goals, next_goals):
        return
    goals, next_goals = (x.reshape(batch.numel(), -1) for x in (goals, next_goals))
    differs = (goals != next_goals) & ~(goals.isnan() & next_goals.isnan())
    rows = differs.any(1).nonzero().flatten()
    if len(rows):
        row = int(rows[0])
        raise ValueError(
            f"{keys.goal!r} and {keys.next_goal!r} differ in "
            f"{len(rows)} of {batch.numel()} rows, first {_format(goals[row])} and "
            f"{_format(next_goals[row])}: 'next' probably holds the first observation "
            "of the next episode, not the last one of this episode, because the "
            "environment has reset itself (torchrl's GymEnv(num_envs=...) does); use "
            "ParallelEnv or SerialEnv of single environments, or write the goal of the "
            "step under 'next'"
        )


def check_time_is_last(batch: TensorDictBase, keys: Keys) -> None:
    """Checks that data without trajectory ids are not [time, num_envs].

    The goal achieved before a step equals the goal that the previous step achieved. So
    if all rows follow each other along the first dimension, but not along the last
    one, the first dimension is time.

    Args:
        batch: Transitions of two dimensions.
        keys: Keys of the goals.

    Raises:
        ValueError: The first dimension is time.
    """
    roots = batch.get(keys.achieved_goal, None)
    if roots is None:
        return
    achieved, ends = batch.get(keys.next_achieved_goal), batch.get(DONE)
    roots, achieved, ends = (
        x.reshape(*batch.shape, -1) for x in (roots, achieved, ends)
    )
    follows_first = (roots[1:] == achieved[:-1]).all(-1, keepdim=True)
    follows_last = (roots[:, 1:] == achieved[:, :-1]).all(-1, keepdim=True)
    if (
        not ends[:-1].all()
        and (follows_first | ends[:-1]).all()
        and not (follows_last | ends[:, :-1]).all()
    ):
        raise ValueError(
            f"data of shape {list(batch.shape)} without trajectory ids must be "
            "[num_envs, time], but their steps follow each other along the first "
            "dimension: call extend(data.transpose(0, 1)), or stack the steps with "
            "torch.stack(steps, dim=1)"
        )


def check_ids_differ(ids: Tensor, shape: torch.Size, key: NestedKey) -> None:
    """Checks that no two environments have the same trajectory id at the same step.

    Args:
        ids: Trajectory ids of transitions, one per transition.
        shape: Batch shape of the transitions, [*environments, time].
        key: Key of the ids.

    Raises:
        ValueError: Two environments have the same id.
    """
    if len(shape) < 2 or ids.numel() != shape.numel():
        return
    ordered, _ = ids.reshape(-1, shape[-1]).sort(0)
    shared = ordered[1:][ordered[1:] == ordered[:-1]]
    if len(shared):
        raise ValueError(
            f"several environments have the trajectory id {int(shared[0])} at {key!r} "
            f"at the same step of data {list(shape)}, so their episodes would be taken "
            "for one: make the ids unique, for example episode * num_envs + "
            "environment; or leave them out, if the data are [num_envs, time]"
        )


class DataCheck:
    """Checks the first sampled batches for entries that relabelling would make wrong.

    Four checks need rows with several different goals:

    - `_check_rewards`: are the stored rewards those of `reward_fn`?
    - `_check_ends`: does success end episodes, if `terminated_fn` says so?
    - `_check_copies`: does an entry contain a copy of the desired goal?
    - `_check_derived`: is an entry an affine function of the goals, such as the
      difference of desired and achieved goal?

    The newest rows of several batches are checked together. Because the checks cost
    time, they stop after `MIN_CHECKS` batches if they saw enough different goals, and
    after `MAX_TOTAL_ROWS` rows in any case.

    Args:
        keys: Keys of the transform.
        ignored: Keys of entries that are not computed from goals, such as ids.

    Attributes:
        shapes: Observation entries of the base environment, without its transforms, and
            their shapes. None if the environment is unknown.
    """

    def __init__(self, keys: Keys, ignored: tuple[NestedKey, ...]) -> None:
        self.shapes: dict[NestedKey, torch.Size] | None = None
        self._keys, self._ignored = keys, ignored
        self.restart()

    def restart(self) -> None:
        """Forgets the rows seen so far, for the data of another buffer."""
        self.is_finished = False
        self._num_checks, self._num_rows = 0, 0
        self._pool: TensorDict | None = None  # the newest rows
        self._warned: set[str] = set()  # subjects of the warnings given so far

    def __call__(
        self,
        batch: TensorDictBase,
        expected: dict[NestedKey, Tensor],
        *,
        keeps_rows: bool,
    ) -> None:
        """Checks sampled transitions, (n,).

        Args:
            batch: The transitions.
            expected: Values by key that the transform computes for the stored goals,
                (n, 1) each: rewards and, if success ends episodes, ends.
            keeps_rows: Whether some rows keep their goal, and so their stored ends.

        Raises:
            ValueError: An entry or the rewards would be wrong after relabelling.
        """
        steps = batch.get("steps_to_next_obs", None)
        if steps is not None and (steps != 1).any():
            raise ValueError(MULTI_STEP_ERROR)
        self._pool = rows = self._gather(batch, expected)
        goals = rows["desired"]
        if (goals != goals[:1]).any():
            self._check_rewards(rows)
            if keeps_rows and "reached" in rows:
                self._check_ends(rows)
            self._check_copies(rows)
            self._num_checks += self._check_derived(rows)
        if self._num_checks >= MIN_CHECKS or self._num_rows > MAX_TOTAL_ROWS:
            self.is_finished, self._pool = True, None

    def _gather(
        self, batch: TensorDictBase, expected: dict[NestedKey, Tensor]
    ) -> TensorDict:
        """Returns the entries to check, of this batch and of earlier ones."""
        keys = self._keys
        part = slice(None, None, -(-len(batch) // MAX_BATCH_ROWS))
        suspects = {
            unravel_key(("suspects", key)): entry[part].flatten(1).clone()
            for key, entry in batch.exclude("next", *self._ignored).items(True, True)
            if key not in (keys.goal, keys.achieved_goal)
            and isinstance(entry, Tensor)
            and 1 < entry.ndim < 4  # images are too large to check
            and entry.dtype != torch.bool
        }
        achieved = batch.get(keys.next_achieved_goal)
        root = batch.get(keys.achieved_goal, achieved)
        others = {
            "desired": batch.get(keys.goal),
            "achieved": achieved,
            "root": root,
            "reward": batch.get(keys.reward),
            "expected": expected[keys.reward],
        }
        if TERMINATED in expected:
            others["terminated"] = batch.get(TERMINATED)
            others["reached"] = expected[TERMINATED]
        others = {key: entry[part].flatten(1).clone() for key, entry in others.items()}
        rows = TensorDict(suspects, [len(others["desired"])]).update(others)
        self._num_rows += len(rows)
        if self._pool is not None and {*rows.keys(True)} == {*self._pool.keys(True)}:
            rows = TensorDict.cat([self._pool, rows])[-MAX_POOL_ROWS:]
        return rows

    def _get_suspects(self, rows: TensorDict) -> dict[NestedKey, Tensor]:
        """Returns the entries that may have been computed from the desired goal."""
        return dict(rows.get("suspects", TensorDict()).items(True, True))

    def _check_copies(self, rows: TensorDict) -> None:
        """Refuses entries that contain the desired goal in adjacent columns.

        Raises:
            ValueError: An entry contains a copy.
        """
        # If the goal is achieved, an observation of the object may rightly equal it.
        differs = (rows["root"] != rows["desired"]).any(1)
        rows = rows[differs]  # type: ignore[assignment]  # a TensorDict
        desired = rows["desired"]
        goal_dim = desired.shape[1]
        if len(desired.unique(dim=0)) < max(2, MIN_GOAL_NUMBERS / goal_dim):
            return
        for key, columns in self._get_suspects(rows).items():
            if columns.shape[1] < goal_dim:
                continue
            # Compare in the less precise type, because a copy may have been rounded.
            dtypes = desired.dtype, columns.dtype
            dtype = min(dtypes, key=lambda x: (not x.is_floating_point, x.itemsize))
            # All windows of goal_dim adjacent columns: (n, windows, goal_dim).
            windows = columns.to(dtype).unfold(1, goal_dim, 1)
            is_equal = (windows == desired[:, None].to(dtype)).all(-1).all(0)
            if is_equal.any():
                raise ValueError(
                    f"{key!r} holds a copy of {self._keys.goal!r} from column "
                    f"{int(is_equal.nonzero()[0])} on, which would keep the old goal: "
                    f"do not concatenate in the environment; {FIX}"
                )

    def _check_derived(self, rows: TensorDict) -> bool:
        """Refuses entries that are affine functions of achieved and desired goal.

        An affine function also fits columns that do not depend on the goals, if it has
        more coefficients than there are different goals: until an object moves, all
        rows of an episode have the same two goals. So this check waits for more goals.
        It accepts columns that the achieved goal alone gives, entries of the base
        environment, and scaled copies of these, such as a normalised observation. An
        observation may rightly contain numbers of the goal: in PegInsertion, the
        position of the hole has the x and y of the desired goal.

        Returns:
            Whether the rows had enough different goals for this check.

        Raises:
            ValueError: A column is derived from the desired goal. If the environment is
                unknown, this is a warning instead.
        """
        is_finite = rows["desired"].isfinite().all(1) & rows["root"].isfinite().all(1)
        rows = rows[is_finite]  # type: ignore[assignment]  # a TensorDict
        achieved, desired = rows["root"].double(), rows["desired"].double()
        goals = torch.cat([achieved, desired], 1)
        if len(desired.unique(dim=0)) <= goals.shape[1] + 1:
            return False
        suspects = self._get_suspects(rows)
        own = {
            key
            for key, shape in (self.shapes or {}).items()
            if key in suspects and shape.numel() == suspects[key].shape[1]
        }
        for key in suspects.keys() - own:
            columns = suspects[key].double()
            is_derived = _is_affine(columns, goals) & ~_is_affine(columns, achieved)
            for own_key in own:
                is_derived &= ~_is_in_copy(columns, suspects[own_key].double())
            if not is_derived.any():
                continue
            message = (
                f"column {int(is_derived.nonzero()[0])} of {key!r} is an affine "
                f"function of {self._keys.goal!r}, and would keep the value of the old "
                f"goal in relabelled rows: {FIX}"
            )
            if self.shapes is not None:
                raise ValueError(message)
            hint = (
                "; or make the transform with from_env, which accepts the entry if "
                "the environment itself returns it"
            )
            self._warn(f"it seems that {message}{hint}", f"derived {key}")
        return True

    def _check_rewards(self, rows: TensorDict) -> None:
        """Checks that the stored rewards are those of `reward_fn`.

        If they differ, this check fits a factor and a constant: stored reward = factor
        * `reward_fn` + constant. An exact fit shows that the rewards were scaled or
        shifted, so the check raises an error. Without such a fit, the check warns.

        Raises:
            ValueError: The rewards were scaled or shifted.
        """
        # Data without desired goals may hold NaN instead.
        is_known = rows["desired"].isfinite().all(1)
        rows = rows[is_known]  # type: ignore[assignment]  # a TensorDict
        if not len(rows):
            return
        stored = rows["reward"].double().flatten()
        expected = rows["expected"].double().flatten()
        low, high = expected.min(), expected.max()
        # Test rows with rare rewards, such as the first successes, separately.
        groups = expected == low, expected == high, stored == stored.max()
        precision = 1e-3 * float(expected.abs().max()) + 1e-6

        def find_wrong_rows(factor: float, constant: float) -> Tensor:
            error = (stored - factor * expected - constant).abs()
            return error > precision * abs(factor)

        def differs(factor: float, constant: float) -> bool:
            # Rounding of the stored goals changes the reward of single rows. So
            # tolerate 5 % of all rows, and half of a group.
            is_wrong = find_wrong_rows(factor, constant).double()
            worst_group = max(float(is_wrong[group].mean()) for group in groups)
            return float(is_wrong.mean()) > 0.05 or worst_group > 0.5

        if not differs(1.0, 0.0):
            return
        at_low, at_high = (stored[group].median() for group in groups[:2])
        factor = float((at_high - at_low) / (high - low).clamp(min=1e-12))
        # A single value of reward_fn cannot determine both numbers: assume constant 0.
        if low == high:
            factor = float(at_low / low) if low else 0.0
        constant = float(at_low) - factor * float(low)
        if factor and not differs(factor, constant):
            raise ValueError(
                f"the stored rewards equal {factor:.4g} * reward_fn + {constant:.4g}, "
                "perhaps because of RewardScaling: scale rewards in the buffer, after "
                'this transform, with in_keys=[("next", "reward")]; or because of '
                "FrameSkipTransform, which adds up rewards: leave it out"
            )
        row = int(find_wrong_rows(1.0, 0.0).nonzero()[0])
        self._warn(
            "reward_fn gives other rewards than the data have: "
            f"{float(expected[row]):.4g} instead of {float(stored[row]):.4g} for "
            f"achieved_goal {_format(rows['achieved'][row])} and desired_goal "
            f"{_format(rows['desired'][row])}; perhaps the environment normalises the "
            "goals",
            "rewards",
        )

    def _check_ends(self, rows: TensorDict) -> None:
        """Warns if `terminated_fn` ends rows at success but the stored episodes go on.

        Rounding of the stored goals changes the success of single rows. So tolerate
        half of the successful rows.
        """
        reached = rows["reached"]
        if (reached & ~rows["terminated"]).sum() > reached.sum() / 2:
            self._warn(
                "episodes go on after success in the data, but terminated_fn ends "
                "relabelled rows at success: pass terminated_fn=None",
                "ends",
            )

    def _warn(self, message: str, subject: str) -> None:
        """Warns, unless there was a warning of the same subject."""
        if subject not in self._warned:
            self._warned.add(subject)
            warnings.warn(message, stacklevel=2)


def _is_affine(columns: Tensor, inputs: Tensor) -> Tensor:
    """Returns which columns are affine functions of the inputs, (m,) bool.

    Args:
        columns: Columns to test, (n, m).
        inputs: Arguments of the functions, (n, k).
    """
    inputs = (inputs - inputs.mean(0)) / inputs.std(0).clamp(min=1e-12)
    centred = columns - columns.mean(0)
    fit = torch.linalg.lstsq(inputs.cpu(), centred.cpu(), rcond=1e-6, driver="gelsd")
    return _is_rounding_error(centred - inputs @ fit.solution.to(inputs), columns)


def _is_in_copy(columns: Tensor, entry: Tensor) -> Tensor:
    """Returns which columns belong to a scaled and shifted copy of an entry, (m,) bool.

    Args:
        columns: Columns to test, (n, m).
        entry: Columns of the entry, (n, k).
    """
    result = torch.zeros(columns.shape[1], dtype=torch.bool, device=columns.device)
    size, entry = entry.shape[1], entry - entry.mean(0)
    for start in range(columns.shape[1] - size + 1):
        block = columns[:, start : start + size]
        centred = block - block.mean(0)
        scale = (centred * entry).sum(0) / entry.square().sum(0).clamp(min=1e-12)
        if _is_rounding_error(centred - scale * entry, block).all():
            result[start : start + size] = True
    return result


def _is_rounding_error(errors: Tensor, columns: Tensor) -> Tensor:
    """Returns in which columns (n, m) float32's rounding explains all errors, (m,)."""
    precision = 1e-5 * columns.std(0) + 1e-6 * columns.abs().amax(0)
    return errors.abs().amax(0) <= precision


def _format(goal: Tensor) -> str:
    """Returns the numbers of a goal, rounded."""
    return f"[{', '.join(f'{x:.4g}' for x in goal.flatten().tolist())}]"
