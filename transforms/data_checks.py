"""Looking at the first batches for what another goal would contradict."""

import warnings

from tensordict import TensorDictBase

from torch_panda.transforms.rewrite import Rewriter, evaluate

# Rows of a batch, and batches asked for several goals, that are looked at.
MAX_ROWS, MAX_BATCHES = 128, 10
MIN_NUMBERS = 6  # of two goals at least: so many do not coincide by chance
N_STEP = (
    "rewards of several steps (MultiStep, MultiStepTransform) are not known for other "
    'goals: store one step a row and sample slices, HindsightRelabel(unit="slice").'
)


class DataCheck:
    """Refuses data in which a new goal would contradict what is not rewritten."""

    def __init__(self, rewriter: Rewriter) -> None:
        self._rewriter = rewriter
        self._batches = 0
        self._has_warned = False

    def __call__(self, batch: TensorDictBase) -> None:
        """Looks at transitions, of any batch shape; a ValueError refuses them."""
        if self._batches == MAX_BATCHES:
            return
        steps = batch.get("steps_to_next_obs", None)
        if steps is not None and (steps != 1).any():
            raise ValueError(N_STEP)
        batch = batch.reshape(-1)
        goals = batch.get(self._rewriter.goal_key)
        if (goals != goals[:1]).any():
            self._batches += 1
            rows = batch[:: -(-len(batch) // MAX_ROWS)]
            self._check_copies(rows)
            self._check_rewards(rows)

    def _check_copies(self, batch: TensorDictBase) -> None:
        """Looks for entries of which some columns are always the desired goal."""
        keys = self._rewriter
        goals = batch.get(keys.goal_key)
        achieved = batch.get(keys.achieved_goal_key, batch.get(keys.next_achieved_key))
        # Where the goal is achieved, an observation may well say so.
        is_open = (achieved != goals).flatten(1).any(1)
        goals = goals.flatten(1)[is_open]
        size = goals.shape[1]
        if len(goals.unique(dim=0)) < max(2, MIN_NUMBERS / size):
            return
        other = batch.exclude("next", "action", keys.goal_key, keys.achieved_goal_key)
        for key, entry in other.items(True, True):
            if entry.ndim not in (2, 3) or entry[0].numel() < size:
                continue
            # A copy may have become less precise, and be stacked as a frame.
            types = goals.dtype, entry.dtype
            coarser = min(types, key=lambda x: (not x.is_floating_point, x.itemsize))
            windows = entry[is_open].flatten(1).to(coarser).unfold(1, size, 1)
            column = (windows == goals[:, None].to(coarser)).all(-1).all(0).nonzero()
            if len(column):
                raise ValueError(
                    f"{key!r} holds a copy of {keys.goal_key!r} from column "
                    f"{int(column[0])} on: do not concatenate in the environment, but "
                    "in the buffer, after this transform (append_transform)."
                )

    def _check_rewards(self, batch: TensorDictBase) -> None:
        """Looks for rewards that are `reward_fn`'s, times a factor plus a constant."""
        keys = self._rewriter
        old, goals = batch.get(keys.reward_key), batch.get(keys.goal_key)
        values = evaluate(keys.reward_fn, batch.get(keys.next_achieved_key), goals, old)
        stored, expected = old.flatten().double(), values.flatten().double()
        low, high = expected.min(), expected.max()
        is_kind = expected == low, expected == high, stored == stored.max()
        # Goals may have been more precise: 1 / 1000 may differ, or 5 % of the rows, but
        # not most rows of a kind: successes may be few.
        precision = 1e-3 * float(expected.abs().max()) + 1e-6

        def differs(factor: float, constant: float) -> bool:
            error = (stored - factor * expected - constant).abs()
            wrong = (error > precision * abs(factor)).double()
            of_kinds = max(float(wrong[rows].mean()) for rows in is_kind)
            return float(wrong.mean()) > 0.05 or of_kinds > 0.5

        if not differs(1.0, 0.0):
            return
        at_low, at_high = (stored[rows].median() for rows in is_kind[:2])
        factor = float((at_high - at_low) / (high - low).clamp(min=1e-12))
        if low == high:  # as long as nothing succeeds: likelier than a constant
            factor = float(at_low / low) if low else 0.0
        constant = float(at_low) - factor * float(low)
        if factor and not differs(factor, constant):
            raise ValueError(
                f"the rewards are reward_fn's times {factor:.4g} plus {constant:.4g} "
                "(RewardScaling?): scale in the buffer, after this transform."
            )
        if not self._has_warned:
            self._has_warned = True
            pair = f"{float(expected[0]):.4g} and {float(stored[0]):.4g}"
            warnings.warn(f"reward_fn gives other rewards than the data have: {pair}.")  # noqa: B028
