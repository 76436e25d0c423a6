"""Hindsight goals at sample time, as a transform of a replay buffer."""

from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase

from torch_panda.transforms.goal_memory import Goals
from torch_panda.transforms.rewrite import GoalFunction
from torch_panda.transforms.sample_time import SampleTimeTransform
from torch_panda.transforms.strategies import Integers, draw_uniform


class HindsightRelabel(SampleTimeTransform):
    """Gives sampled transitions goals that were achieved later in their trajectory.

    Hindsight experience replay (Andrychowicz et al. 2017, arXiv 1707.01495): a random
    fraction `her_ratio` of the sampled rows gets another goal, with the reward of that
    goal. The other rows come out as they were stored. README.md in this folder is a
    guide.

    Strategies draw the goal from what a transition's own trajectory achieved: at this
    step or later, uniformly ("future") or preferring early steps ("geometric"), at this
    step ("current"), at the last step ("final"), or at any step ("episode"). Or they
    draw from all stored transitions: an achieved goal ("random") or a desired goal
    ("desired").

    Args:
        reward_fn: Maps (achieved_goal, desired_goal), (n, *goal) each, to the reward,
            (n, 1).
        her_ratio: Fraction of the rows to relabel; k / (k + 1) for the paper's k goals.
        goal_parts: Sizes of the parts of a goal vector, such as (3, 3). Each part is
            relabelled on its own, with probability `her_ratio` (Lanier et al. 2019,
            arXiv 1906.03710).
        **options: `unit` and `capacity` (see `SampleTimeTransform`), and arguments of
            `BufferTransform`. A `SliceSampler` overwrites the new ends with the stored
            ones unless its `truncated_key` is None.

    Raises:
        TypeError: an argument is unknown.
        ValueError: an argument has a value that is not accepted.
    """

    _shown = ("strategy", "her_ratio", "unit", "goal_parts")

    def __init__(
        self,
        reward_fn: GoalFunction,
        *,
        her_ratio: float = 0.8,
        goal_parts: tuple[int, ...] | None = None,
        **options: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(reward_fn, **options)
        if not 0 <= her_ratio <= 1:
            raise ValueError(f"her_ratio must be within [0, 1], got {her_ratio}")
        if goal_parts is not None and (not goal_parts or min(goal_parts) < 1):
            raise ValueError(f"goal_parts must be positive sizes, got {goal_parts!r}")
        self.her_ratio, self.goal_parts = her_ratio, goal_parts

    def _draw(self, serials: Integers, batch: TensorDictBase) -> tuple[Integers, Goals]:
        """Draws which m rows to relabel, (m,), and their goals, (m, *goal)."""
        last_rows, units = self._find_units(serials)
        if self.goal_parts is None:
            return self._draw_once(serials, last_rows, units)
        stored_goals = batch.get(self._rewriter.goal_key)
        goals = stored_goals.reshape(len(serials), -1).numpy(force=True).copy()
        is_relabelled = np.zeros(len(goals), dtype=bool)
        for end, size in zip(np.cumsum(self.goal_parts), self.goal_parts, strict=True):
            part = slice(end - size, end)
            rows, drawn = self._draw_once(serials, last_rows, units)
            goals[rows, part] = drawn[:, part]
            is_relabelled[rows] = True
        return is_relabelled.nonzero()[0], goals[is_relabelled]

    def _draw_once(
        self, serials: Integers, last_rows: Integers, units: Integers | None
    ) -> tuple[Integers, Goals]:
        """Draws which units to relabel, and a goal for each of them.

        Returns:
            Rows of these units, (n,), and the goals of these rows, (n, *goal).
        """
        u = draw_uniform(len(last_rows), self._generator)
        is_chosen = u < self.her_ratio
        # Another thread may have overwritten a sampled row: it keeps its goal.
        is_forgotten = serials < self._memory.oldest
        is_chosen[is_forgotten if units is None else units[is_forgotten]] = False
        chosen = is_chosen.nonzero()[0]
        goals = self._memory.draw(
            last_rows.take(chosen), self._mixture, self._generator
        )
        if units is None:
            return chosen, goals
        rows = is_chosen[units].nonzero()[0]
        index_of_unit = is_chosen.cumsum() - 1  # of chosen units, into `goals`
        return rows, goals[index_of_unit[units[rows]]]

    def _write(
        self,
        batch: TensorDictBase,
        drawn: tuple[Integers, Goals],
        *,
        inplace: bool,
    ) -> TensorDictBase:
        device = batch.get(self._rewriter.goal_key).device
        rows, goals = (torch.from_numpy(array).to(device) for array in drawn)
        if not len(rows):
            return batch
        return self._rewriter.rewrite(batch, rows, goals, inplace=inplace)
