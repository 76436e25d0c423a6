"""Checks that refuse data in which relabelled transitions would contradict themselves.

A relabelled transition has another goal and the reward of that goal. An entry that was
computed from the old goal before keeps its old value, for instance a concatenation of
observation and goal. The agent would then learn from two goals in one transition.
"""

import warnings
from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from torch_panda.transforms.rewrite import Rewriter, call_goal_function

MAX_ROWS = 128  # rows of one batch that are checked
MAX_POOL = 512  # rows that are pooled over batches
MIN_CHECKS = 10  # checks of rows with several goals, before the checks end
MAX_TOTAL_ROWS = 100_000  # the checks end after so many rows in any case
MIN_NUMBERS = 6  # fewer numbers, in different goals, may equal a column by chance

MULTI_STEP_ERROR = (
    "rewards of several steps (MultiStep, MultiStepTransform) cannot be recomputed for "
    "other goals: store one step per row, and sample slices with "
    'HindsightRelabel(unit="slice")'
)
CURE = "compute it in the buffer, after this transform (append_transform)"


def check_goals_agree(batch: TensorDictBase, rewriter: Rewriter) -> None:
    """Checks that every transition has the same desired goal before and after it.

    Raises:
        ValueError: the goals of a transition differ.
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
            f"{_format(next_goals[row])}: 'next' is probably not the end of the "
            "episode, because the environment has reset itself (torchrl's "
            "GymEnv(num_envs=...) does); use ParallelEnv or SerialEnv of single "
            "environments, or write the goal of the step under 'next'"
        )


class DataCheck:
    """Checks the first batches for entries and rewards that contradict another goal.

    Args:
        rewriter: Functions and keys of the transform.
        ignored: Keys of entries that are not computed from goals, such as ids.
        warned: Warnings that were given already, shared by the checks of a transform.

    Attributes:
        shapes: Entries of the environment without its transforms, and their shapes; or
            None if the environment is not known.
    """

    def __init__(
        self, rewriter: Rewriter, ignored: Sequence[NestedKey], warned: set[str]
    ) -> None:
        self.shapes: dict[NestedKey, torch.Size] | None = None
        self._rewriter = rewriter
        self._ignored = ignored
        self._warned = warned
        self._is_finished = False
        self._checks, self._total_rows = 0, 0
        self._recent: TensorDictBase | None = None  # rows since the last check
        self._pool: TensorDictBase | None = None  # rows of all checks

    def __call__(self, batch: TensorDictBase) -> None:
        """Checks transitions, of any batch shape.

        Raises:
            ValueError: an entry or the rewards contradict another goal.
        """
        if self._is_finished:
            return
        steps = batch.get("steps_to_next_obs", None)
        if steps is not None and (steps != 1).any():
            raise ValueError(MULTI_STEP_ERROR)
        rows = self._select(batch)
        self._total_rows += len(rows)
        recent = _cat(self._recent, rows)
        goals = recent.get(self._rewriter.goal_key)
        if (goals != goals[:1]).any():
            self._recent, self._pool = None, _cat(self._pool, recent)
            self._check_rewards(recent)
            self._check_copies(self._pool)
            is_conclusive = self._check_computed(self._pool)
            self._checks += 1
            self._is_finished = is_conclusive and self._checks >= MIN_CHECKS
        else:
            self._recent = recent
        if self._is_finished or self._total_rows > MAX_TOTAL_ROWS:
            self._is_finished, self._recent, self._pool = True, None, None

    def _select(self, batch: TensorDictBase) -> TensorDictBase:
        """Returns a copy of some rows and of the entries that the checks read."""
        keys = self._rewriter
        rows = batch.reshape(-1)
        rows = rows[:: -(-len(rows) // MAX_ROWS)]
        candidates = [
            key
            for key, entry in rows.exclude("next", *self._ignored).items(True, True)
            if isinstance(entry, Tensor)
            and entry.ndim < 4
            and entry.dtype != torch.bool
        ]
        goal_keys = keys.goal_key, keys.achieved_goal_key, keys.next_achieved_key
        needed = {*candidates, *goal_keys, keys.reward_key}
        return rows.select(*needed, strict=False).to_tensordict()

    def _candidates(self, rows: TensorDictBase) -> dict[NestedKey, Tensor]:
        """Returns the entries that may be computed from the desired goal."""
        keys = self._rewriter
        others = rows.exclude("next", keys.goal_key, keys.achieved_goal_key)
        return {key: entry for key, entry in others.items(True, True)}

    def _goals(self, rows: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Returns achieved and desired goals of the same time, (n, goal_dim) each."""
        keys = self._rewriter
        achieved = rows.get(keys.achieved_goal_key, rows.get(keys.next_achieved_key))
        return achieved.flatten(1), rows.get(keys.goal_key).flatten(1)

    def _check_copies(self, rows: TensorDictBase) -> None:
        """Refuses entries of which some columns are always the desired goal."""
        achieved, desired = self._goals(rows)
        # Skip achieved goals: the observation equals the goal there anyway.
        is_open = (achieved != desired).any(1)
        desired = desired[is_open]
        goal_dim = desired.shape[1]
        if len(desired.unique(dim=0)) < max(2, MIN_NUMBERS / goal_dim):
            return
        for key, entry in self._candidates(rows).items():
            if entry.ndim < 2 or entry[0].numel() < goal_dim:
                continue
            # A copy may be less precise than the goal, and stacked as a frame.
            dtypes = desired.dtype, entry.dtype
            dtype = min(dtypes, key=lambda x: (not x.is_floating_point, x.itemsize))
            windows = entry[is_open].flatten(1).to(dtype).unfold(1, goal_dim, 1)
            equal = (windows == desired[:, None].to(dtype)).all(-1).all(0).nonzero()
            if len(equal):
                raise ValueError(
                    f"{key!r} holds a copy of {self._rewriter.goal_key!r} from column "
                    f"{int(equal[0])} on, which would keep the old goal: do not "
                    f"concatenate in the environment; {CURE}"
                )

    def _check_computed(self, rows: TensorDictBase) -> bool:
        """Refuses entries that are affine functions of achieved and desired goal.

        An entry is suspect if the environment without its transforms does not have it
        in the same shape. A column passes if the achieved goal alone reproduces it, or
        if it belongs to a copy of one of the environment's own entries, which may
        contain constants of an episode. Such constants could fit by chance, so the
        check needs more different goals than an affine function has coefficients.

        Returns:
            Whether the rows have enough different goals to tell.

        Raises:
            ValueError: The environment is known, and a suspect depends on the goal. If
                it is not known, this is a warning.
        """
        both = torch.cat(self._goals(rows), 1).double()
        goal_dim = both.shape[1] // 2
        is_finite = both.isfinite().all(1)
        both = both[is_finite]
        rows = rows[is_finite]  # type: ignore[assignment]  # a TensorDict
        achieved, desired = both.split(goal_dim, 1)
        if len(desired.unique(dim=0)) <= 2 * goal_dim + 1:
            return False
        own: list[Tensor] = []
        suspects: dict[NestedKey, Tensor] = {}
        for key, entry in self._candidates(rows).items():
            columns = entry.reshape(len(entry), -1).double()
            if self.shapes is not None and self.shapes.get(key) == entry.shape[1:]:
                own.append(columns)
            else:
                suspects[key] = columns
        for key, columns in suspects.items():
            is_computed = _is_affine(columns, both) & ~_is_affine(columns, achieved)
            for column in is_computed.nonzero().flatten().tolist():
                if any(_is_in_copy(column, columns, entry) for entry in own):
                    continue
                message = (
                    f"column {column} of {key!r} is an affine function of "
                    f"{self._rewriter.goal_key!r}, and would keep the value of the old "
                    f"goal in relabelled rows: {CURE}"
                )
                if self.shapes is not None:
                    raise ValueError(message)
                hint = "; or make the transform with from_env, if the task observes it"
                self._warn(f"it seems that {message}{hint}", f"computed {key}")
                break
        return True

    def _check_rewards(self, rows: TensorDictBase) -> None:
        """Refuses rewards of `reward_fn` that were scaled or shifted."""
        keys = self._rewriter
        stored, goals = rows.get(keys.reward_key), rows.get(keys.goal_key)
        achieved = rows.get(keys.next_achieved_key)
        expected = call_goal_function(keys.reward_fn, achieved, goals, stored)
        stored, expected = stored.flatten().double(), expected.flatten().double()
        low, high = expected.min(), expected.max()
        groups = expected == low, expected == high, stored == stored.max()
        # Rounded goals may change single rewards (5 % of the rows), but not most of the
        # rarer ones.
        precision = 1e-3 * float(expected.abs().max()) + 1e-6

        def find_wrong(factor: float, constant: float) -> Tensor:
            error = (stored - factor * expected - constant).abs()
            return error > precision * abs(factor)

        def differs(factor: float, constant: float) -> bool:
            wrong = find_wrong(factor, constant).double()
            worst_group = max(float(wrong[group].mean()) for group in groups)
            return float(wrong.mean()) > 0.05 or worst_group > 0.5

        if not differs(1.0, 0.0):
            return
        at_low, at_high = (stored[group].median() for group in groups[:2])
        factor = float((at_high - at_low) / (high - low).clamp(min=1e-12))
        if low == high:  # with one reward value, assume a factor and no constant
            factor = float(at_low / low) if low else 0.0
        constant = float(at_low) - factor * float(low)
        if factor and not differs(factor, constant):
            raise ValueError(
                f"the rewards are reward_fn's times {factor:.4g} plus {constant:.4g} "
                "(RewardScaling?): scale in the buffer, after this transform"
            )
        row = int(find_wrong(1.0, 0.0).nonzero()[0])
        self._warn(
            "reward_fn gives other rewards than the data have: "
            f"{float(expected[row]):.4g} instead of {float(stored[row]):.4g} for "
            f"achieved_goal {_format(achieved[row])} and desired_goal "
            f"{_format(goals[row])} (goals that the environment normalised?)",
            "rewards",
        )

    def _warn(self, message: str, subject: str) -> None:
        """Warns once of a subject."""
        if subject not in self._warned:
            self._warned.add(subject)
            warnings.warn(message, stacklevel=2)


def _is_affine(columns: Tensor, inputs: Tensor) -> Tensor:
    """Returns which columns, (n, m), are affine functions of inputs, (n, k): (m,)."""
    spread = inputs.std(0).clamp(min=1e-12)
    scaled = (inputs - inputs.mean(0)) / spread
    u, s, _ = torch.linalg.svd(scaled, full_matrices=False)
    basis = u[:, s > 1e-6 * s.max().clamp(min=1e-12)]
    centred = columns - columns.mean(0)
    return _is_small(centred - basis @ (basis.T @ centred), columns)


def _is_in_copy(column: int, columns: Tensor, entry: Tensor) -> bool:
    """Returns whether a column belongs to a copy, scaled and shifted, of an entry.

    Args:
        column: Number of the column.
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
            if _is_small(centred - scale * entry, block).all():
                return True
    return False


def _is_small(error: Tensor, columns: Tensor) -> Tensor:
    """Returns in which columns, (n, m), an error is one of float32: (m,)."""
    precision = 1e-5 * columns.std(0) + 1e-6 * columns.abs().amax(0)
    return error.abs().amax(0) <= precision


def _cat(pool: TensorDictBase | None, rows: TensorDictBase) -> TensorDictBase:
    """Appends rows to a pool, keeps their common entries, and thins a large pool."""
    if pool is not None:
        common = {*pool.keys(True, True)} & {*rows.keys(True, True)}
        # torch's functions are annotated for tensors only.
        rows = torch.cat([pool.select(*common), rows.select(*common)])  # type: ignore[assignment]
    return rows[::2].clone() if len(rows) > MAX_POOL else rows  # type: ignore[return-value]


def _format(goal: Tensor) -> str:
    """Returns the numbers of a goal, rounded."""
    return f"[{', '.join(f'{x:.4g}' for x in goal.flatten().tolist())}]"
