"""Checks that refuse data in which relabelled transitions would contradict themselves.

A relabelled transition gets another goal and the reward of that goal. All other entries
stay as they were stored. If one of them was computed from the old goal, for instance a
concatenation of observation and goal, the transition then contains two goals.
"""

import warnings
from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from torch_panda.transforms.rewrite import (
    DONE,
    TERMINATED,
    Rewriter,
    call_goal_function,
)

MAX_BATCH_ROWS = 128  # rows of one batch that are checked
MAX_POOL_ROWS = 512  # rows of earlier batches that are kept for the next check
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
FIX = "compute it in the buffer, after this transform (append_transform)"


def check_goals_agree(batch: TensorDictBase, rewriter: Rewriter) -> None:
    """Checks that every transition has the same desired goal before and after it.

    Raises:
        ValueError: The two goals of a transition differ.
    """
    goals, next_goals = batch.get(rewriter.goal_key), batch.get(rewriter.next_goal_key)
    if torch.equal(goals, next_goals):
        return
    goals, next_goals = (x.reshape(batch.numel(), -1) for x in (goals, next_goals))
    differs = (goals != next_goals) & ~(goals.isnan() & next_goals.isnan())
    rows = differs.any(1).nonzero().flatten()
    if len(rows):
        row = int(rows[0])
        raise ValueError(
            f"{rewriter.goal_key!r} and {rewriter.next_goal_key!r} differ in "
            f"{len(rows)} of {batch.numel()} rows, first {_format(goals[row])} and "
            f"{_format(next_goals[row])}: 'next' probably holds the first observation "
            "of the next episode, not the last one of this episode, because the "
            "environment has reset itself (torchrl's GymEnv(num_envs=...) does); use "
            "ParallelEnv or SerialEnv of single environments, or write the goal of the "
            "step under 'next'"
        )


def check_time_is_last(batch: TensorDictBase, rewriter: Rewriter) -> None:
    """Checks that data without trajectory ids are not [time, num_envs].

    The goal achieved before a step equals the goal that the previous step achieved. So
    if all rows follow each other along the first dimension, but not along the last
    one, the first dimension is time.

    Args:
        batch: Transitions of two dimensions.
        rewriter: Keys of the transform.

    Raises:
        ValueError: The first dimension is time.
    """
    roots = batch.get(rewriter.achieved_goal_key, None)
    if roots is None:
        return
    achieved, ends = batch.get(rewriter.next_achieved_key), batch.get(DONE)
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
    """Checks the first batches for entries that relabelling would make wrong.

    Four checks need rows with several different goals:

    - `_check_rewards`: are the stored rewards those of `reward_fn`?
    - `_check_ends`: does success end episodes, if `terminated_fn` says so?
    - `_check_copies`: does an entry contain a copy of the desired goal?
    - `_check_affine`: is an entry an affine function of the goals, such as the
      difference of desired and achieved goal?

    Rows are collected until their goals differ. Then all four checks run. Because they
    cost time, they stop after `MIN_CHECKS` runs if they saw enough different goals, and
    after `MAX_TOTAL_ROWS` rows in any case.

    Args:
        rewriter: Functions and keys of the transform.
        ignored: Keys of entries that are not computed from goals, such as ids.
        warned: Subjects of the warnings given so far. The two `DataCheck` objects of a
            transform share this set, so that each warning is given once.

    Attributes:
        shapes: Observation entries of the base environment, without its transforms, and
            their shapes. None if the environment is unknown.
    """

    def __init__(
        self, rewriter: Rewriter, ignored: Sequence[NestedKey], warned: set[str]
    ) -> None:
        self.shapes: dict[NestedKey, torch.Size] | None = None
        self._rewriter = rewriter
        self._ignored = ignored
        self._warned = warned
        self._is_finished = False
        self._num_checks, self._num_rows = 0, 0
        self._unchecked: TensorDictBase | None = None  # rows since the last check
        self._pool: TensorDictBase | None = None  # rows of all checks, thinned out

    def __call__(self, batch: TensorDictBase, *, keeps_rows: bool) -> None:
        """Checks transitions, of any batch shape.

        Args:
            batch: The transitions.
            keeps_rows: Whether some rows keep their goal, and so their stored ends.

        Raises:
            ValueError: An entry or the rewards would be wrong after relabelling.
        """
        if self._is_finished:
            return
        steps = batch.get("steps_to_next_obs", None)
        if steps is not None and (steps != 1).any():
            raise ValueError(MULTI_STEP_ERROR)
        rows = self._select(batch)
        self._num_rows += len(rows)
        self._unchecked = rows = _append(self._unchecked, rows)
        goals = rows.get(self._rewriter.goal_key)
        if (goals != goals[:1]).any():
            self._unchecked, self._pool = None, _append(self._pool, rows)
            self._check_rewards(rows)
            if keeps_rows:
                self._check_ends(rows)
            self._check_copies(self._pool)
            has_enough_goals = self._check_affine(self._pool)
            self._num_checks += 1
            self._is_finished = has_enough_goals and self._num_checks >= MIN_CHECKS
        if self._is_finished or self._num_rows > MAX_TOTAL_ROWS:
            self._is_finished, self._unchecked, self._pool = True, None, None

    def _select(self, batch: TensorDictBase) -> TensorDictBase:
        """Returns a copy of some rows and of the entries that the checks read."""
        rewriter = self._rewriter
        rows = batch.reshape(-1)
        rows = rows[:: -(-len(rows) // MAX_BATCH_ROWS)]
        suspects = [
            key
            for key, entry in rows.exclude("next", *self._ignored).items(True, True)
            if isinstance(entry, Tensor)
            and entry.ndim < 4  # images are too large to check
            and entry.dtype != torch.bool
        ]
        goal_keys = (
            rewriter.goal_key,
            rewriter.achieved_goal_key,
            rewriter.next_achieved_key,
        )
        selected = {*suspects, *goal_keys, rewriter.reward_key, TERMINATED}
        return rows.select(*selected, strict=False).to_tensordict()

    def _get_suspects(self, rows: TensorDictBase) -> dict[NestedKey, Tensor]:
        """Returns the entries that may have been computed from the desired goal."""
        rewriter = self._rewriter
        others = rows.exclude("next", rewriter.goal_key, rewriter.achieved_goal_key)
        return dict(others.items(True, True))

    def _get_goals(self, rows: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Returns achieved and desired goals, (n, goal_dim) each."""
        rewriter = self._rewriter
        achieved = rows.get(
            rewriter.achieved_goal_key, rows.get(rewriter.next_achieved_key)
        )
        return achieved.flatten(1), rows.get(rewriter.goal_key).flatten(1)

    def _check_copies(self, rows: TensorDictBase) -> None:
        """Refuses entries that contain the desired goal in adjacent columns.

        Raises:
            ValueError: An entry contains a copy.
        """
        achieved, desired = self._get_goals(rows)
        # If the goal is achieved, an observation of the object may rightly equal it.
        is_not_achieved = (achieved != desired).any(1)
        desired = desired[is_not_achieved]
        goal_dim = desired.shape[1]
        if len(desired.unique(dim=0)) < max(2, MIN_GOAL_NUMBERS / goal_dim):
            return
        for key, entry in self._get_suspects(rows).items():
            if entry.ndim < 2 or entry[0].numel() < goal_dim:
                continue
            # Compare in the less precise type, because a copy may have been rounded.
            dtypes = desired.dtype, entry.dtype
            dtype = min(dtypes, key=lambda x: (not x.is_floating_point, x.itemsize))
            # All windows of goal_dim adjacent columns: (n, windows, goal_dim).
            columns = entry[is_not_achieved].flatten(1).to(dtype)
            windows = columns.unfold(1, goal_dim, 1)
            is_equal = (windows == desired[:, None].to(dtype)).all(-1).all(0)
            if is_equal.any():
                raise ValueError(
                    f"{key!r} holds a copy of {self._rewriter.goal_key!r} from column "
                    f"{int(is_equal.nonzero()[0])} on, which would keep the old goal: "
                    f"do not concatenate in the environment; {FIX}"
                )

    def _check_affine(self, rows: TensorDictBase) -> bool:
        """Refuses entries that are affine functions of achieved and desired goal.

        An affine function has 2 * goal_dim + 1 coefficients per column. With too few
        equations, it also fits columns that do not depend on the goals. Until an object
        moves, all rows of an episode have the same achieved and the same desired goal,
        so together they give one equation. Therefore the check waits until there are
        more distinct desired goals than coefficients.

        Then the check refuses a column if an affine function fits it, with three
        exceptions:

        - The base environment itself has the entry, in the same shape.
        - An affine function of the achieved goal alone fits the column.
        - The column belongs to a scaled copy of one of the base environment's entries,
          such as a normalised observation. An observation may rightly contain numbers
          of the goal: in PegInsertion, the position of the hole has the x and y of the
          desired goal.

        Returns:
            Whether the rows had enough different goals for this check.

        Raises:
            ValueError: A column is refused. If the environment is unknown, this is a
                warning instead.
        """
        goals = torch.cat(self._get_goals(rows), 1).double()
        goal_dim = goals.shape[1] // 2
        is_finite = goals.isfinite().all(1)
        goals = goals[is_finite]
        rows = rows[is_finite]  # type: ignore[assignment]  # a TensorDict
        achieved, desired = goals.split(goal_dim, 1)
        if len(desired.unique(dim=0)) <= 2 * goal_dim + 1:
            return False
        env_entries: list[Tensor] = []
        suspects: dict[NestedKey, Tensor] = {}
        for key, entry in self._get_suspects(rows).items():
            columns = entry.reshape(len(entry), -1).double()
            if self.shapes is not None and self.shapes.get(key) == entry.shape[1:]:
                env_entries.append(columns)
            else:
                suspects[key] = columns
        for key, columns in suspects.items():
            needs_desired = _is_affine(columns, goals) & ~_is_affine(columns, achieved)
            for column in needs_desired.nonzero().flatten().tolist():
                if any(_is_in_copy(column, columns, entry) for entry in env_entries):
                    continue
                message = (
                    f"column {column} of {key!r} is an affine function of "
                    f"{self._rewriter.goal_key!r}, and would keep the value of the old "
                    f"goal in relabelled rows: {FIX}"
                )
                if self.shapes is not None:
                    raise ValueError(message)
                hint = (
                    "; or make the transform with from_env, which accepts the entry if "
                    "the environment itself returns it"
                )
                self._warn(f"it seems that {message}{hint}", f"computed {key}")
                break
        return True

    def _check_rewards(self, rows: TensorDictBase) -> None:
        """Checks that the stored rewards are those of `reward_fn`.

        If they differ, this check fits a factor and a constant: stored reward = factor
        * `reward_fn` + constant. An exact fit shows that the rewards were scaled or
        shifted, so the check raises an error. Without such a fit, the check warns.

        Raises:
            ValueError: The rewards were scaled or shifted.
        """
        rewriter = self._rewriter
        # Data without desired goals may hold NaN instead.
        is_known = rows.get(rewriter.goal_key).flatten(1).isfinite().all(1)
        if not is_known.any():
            return
        rows = rows[is_known]  # type: ignore[assignment]  # a TensorDict
        stored, goals = rows.get(rewriter.reward_key), rows.get(rewriter.goal_key)
        achieved = rows.get(rewriter.next_achieved_key)
        expected = call_goal_function(rewriter.reward_fn, achieved, goals, stored)
        stored, expected = stored.flatten().double(), expected.flatten().double()
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
            f"achieved_goal {_format(achieved[row])} and desired_goal "
            f"{_format(goals[row])}; perhaps the environment normalises the goals",
            "rewards",
        )

    def _check_ends(self, rows: TensorDictBase) -> None:
        """Warns if `terminated_fn` ends rows at success but the stored episodes go on.

        Rounding of the stored goals changes the success of single rows. So tolerate
        half of the successful rows.
        """
        rewriter = self._rewriter
        if rewriter.terminated_fn is None:
            return
        terminated = rows.get(TERMINATED)
        reached = call_goal_function(
            rewriter.terminated_fn,
            rows.get(rewriter.next_achieved_key),
            rows.get(rewriter.goal_key),
            terminated,
        )
        if (reached & ~terminated).sum() > reached.sum() / 2:
            self._warn(
                "episodes go on after success in the data, but terminated_fn ends "
                "relabelled rows at success: pass terminated_fn=None",
                "ends",
            )

    def _warn(self, message: str, subject: str) -> None:
        """Warns, unless this transform has given a warning of the same subject."""
        if subject not in self._warned:
            self._warned.add(subject)
            warnings.warn(message, stacklevel=2)


def _is_affine(columns: Tensor, inputs: Tensor) -> Tensor:
    """Returns which columns are affine functions of the inputs.

    An affine function fits a column if the centred column lies in the space that the
    centred inputs span.

    Args:
        columns: Columns to test, (n, m).
        inputs: Arguments of the functions, (n, k).

    Returns:
        Whether a function fits each column, (m,) bool.
    """
    spread = inputs.std(0).clamp(min=1e-12)
    scaled = (inputs - inputs.mean(0)) / spread
    u, s, _ = torch.linalg.svd(scaled, full_matrices=False)
    basis = u[:, s > 1e-6 * s.max().clamp(min=1e-12)]
    centred = columns - columns.mean(0)
    return _is_rounding_error(centred - basis @ (basis.T @ centred), columns)


def _is_in_copy(column: int, columns: Tensor, entry: Tensor) -> bool:
    """Returns whether a column belongs to a scaled and shifted copy of an entry.

    Args:
        column: Index of the column.
        columns: All columns of the suspect, (n, m).
        entry: Columns of an entry of the environment, (n, k).
    """
    size = entry.shape[1]
    entry = entry - entry.mean(0)
    for start in range(max(0, column - size + 1), column + 1):
        block = columns[:, start : start + size]
        if block.shape == entry.shape:
            centred = block - block.mean(0)
            scale = (centred * entry).sum(0) / entry.square().sum(0).clamp(min=1e-12)
            if _is_rounding_error(centred - scale * entry, block).all():
                return True
    return False


def _is_rounding_error(errors: Tensor, columns: Tensor) -> Tensor:
    """Returns whether all errors of a column are as small as float32's rounding errors.

    Args:
        errors: Deviations from the columns, (n, m).
        columns: The columns, (n, m).

    Returns:
        Whether all errors of each column are small, (m,) bool.
    """
    precision = 1e-5 * columns.std(0) + 1e-6 * columns.abs().amax(0)
    return errors.abs().amax(0) <= precision


def _append(pool: TensorDictBase | None, rows: TensorDictBase) -> TensorDictBase:
    """Appends rows to a pool, with the entries that both have.

    If there are more than `MAX_POOL_ROWS` rows, only every second one is returned.
    """
    if pool is not None:
        common = {*pool.keys(True, True)} & {*rows.keys(True, True)}
        # torch's functions are annotated for tensors only.
        rows = torch.cat([pool.select(*common), rows.select(*common)])  # type: ignore[assignment]
    return rows[::2].clone() if len(rows) > MAX_POOL_ROWS else rows  # type: ignore[return-value]


def _format(goal: Tensor) -> str:
    """Returns the numbers of a goal, rounded."""
    return f"[{', '.join(f'{x:.4g}' for x in goal.flatten().tolist())}]"
