"""HindsightRelabel: hindsight goals for the batches that a replay buffer samples."""

from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase

from torch_panda.transforms.goal_memory import Goals
from torch_panda.transforms.rewrite import GoalFunction
from torch_panda.transforms.sample_time import SampleTimeTransform
from torch_panda.transforms.strategies import Integers, draw_uniform


class HindsightRelabel(SampleTimeTransform):
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
            (n, 1).
        her_ratio: Fraction of the rows to relabel. The paper's k hindsight goals per
            transition correspond to k / (k + 1).
        goal_parts: Sizes of the parts of a goal vector, such as (3, 3). Each part is
            relabelled on its own, with probability `her_ratio` (Lanier et al. 2019,
            arXiv 1906.03710).
        **options: `unit` and `capacity` (see `SampleTimeTransform`), and arguments of
            `BufferTransform`. If the buffer has a `SliceSampler`, make the sampler
            with `truncated_key=None`. Otherwise it overwrites "terminated", "truncated"
            and "done" of relabelled rows.

    Raises:
        TypeError: An argument is unknown.
        ValueError: An argument has a value that is not accepted.
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
        self._keeps_rows = her_ratio < 1

    def _draw(self, serials: Integers, batch: TensorDictBase) -> tuple[Integers, Goals]:
        """Draws which m rows to relabel, (m,), and their goals, (m, *goal)."""
        last_serials, units = self._find_units(serials)
        if self.goal_parts is None:
            return self._draw_once(serials, last_serials, units)
        goals = batch.get(self._rewriter.goal_key).numpy(force=True).copy()
        is_relabelled = np.zeros(len(goals), dtype=bool)
        for end, size in zip(np.cumsum(self.goal_parts), self.goal_parts, strict=True):
            part = slice(end - size, end)
            rows, drawn = self._draw_once(serials, last_serials, units)
            goals[rows, part] = drawn[:, part]
            is_relabelled[rows] = True
        return is_relabelled.nonzero()[0], goals[is_relabelled]

    def _draw_once(
        self, serials: Integers, last_serials: Integers, units: Integers | None
    ) -> tuple[Integers, Goals]:
        """Draws which units (rows or slices) to relabel, and a goal for each of them.

        Args:
            serials: Serial numbers of the rows, (n,).
            last_serials: Serial number of the last row of each unit, (num_units,).
                Future goals of a unit are achieved in this row or later.
            units: Unit of each row, (n,). None if each row is a unit.

        Returns:
            Indices of the m rows to relabel, (m,), and their goals, (m, *goal).
        """
        u = draw_uniform(len(last_serials), self._generator)
        is_chosen = u < self.her_ratio
        # A row that another thread has overwritten since it was sampled keeps its goal,
        # and so does its slice.
        is_forgotten = serials < self._memory.oldest
        is_chosen[is_forgotten if units is None else units[is_forgotten]] = False
        chosen_units = is_chosen.nonzero()[0]
        goals = self._memory.draw(
            last_serials.take(chosen_units), self._mixture, self._generator
        )
        if units is None:
            return chosen_units, goals
        rows = is_chosen[units].nonzero()[0]
        # The goal of the chosen unit i is goals[goal_index[i]].
        goal_index = is_chosen.cumsum() - 1
        return rows, goals[goal_index[units[rows]]]

    def _write(self, batch: TensorDictBase, drawn: tuple[Integers, Goals]) -> None:
        device = batch.get(self._rewriter.goal_key).device
        rows, goals = (torch.from_numpy(array).to(device) for array in drawn)
        if len(rows):
            self._rewriter.rewrite(batch, rows, goals)
