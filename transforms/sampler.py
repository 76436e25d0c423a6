"""GoalSampler: several goals for each transition that a replay buffer samples."""

from collections.abc import Collection, Mapping
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torchrl import envs
from typing_extensions import Self

from torch_panda.transforms.goal_memory import Goals
from torch_panda.transforms.rewrite import GoalFunction
from torch_panda.transforms.sample_time import SampleTimeTransform
from torch_panda.transforms.strategies import Integers, Mixture, StrategyOption


class GoalSampler(SampleTimeTransform):
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

    Args:
        strategies: For each key, a strategy as in `HindsightRelabel`: a name, a
            function, or a mapping of these to weights.
        reward_fn: Maps (achieved_goal, desired_goal), (n, *goal) each, to the reward,
            (n, 1).
        **options: `unit` and `capacity` (see `SampleTimeTransform`), and arguments of
            `BufferTransform` except `strategy`.

    Raises:
        TypeError: An argument is unknown.
        ValueError: An argument has a value that is not accepted.
    """

    _keeps_rows = False
    _shown = ("strategies", "discount", "unit")

    def __init__(
        self,
        strategies: Mapping[Any, StrategyOption],
        reward_fn: GoalFunction,
        **options: Any,  # noqa: ANN401
    ) -> None:
        if "strategy" in options:
            raise TypeError(
                "GoalSampler has no argument 'strategy'; pass strategies, one for each "
                'key, such as {"value_goal": "geometric"}'
            )
        super().__init__(reward_fn, **options)
        if not isinstance(strategies, Mapping) or not strategies:
            raise ValueError(
                "strategies must map keys of new entries to strategies, such as "
                f'{{"value_goal": "geometric"}}, got {strategies!r}'
            )
        self.strategies = {**strategies}
        self._mixtures: dict[NestedKey, Mixture] = {
            unravel_key(key): Mixture.parse(strategy, self.discount)
            for key, strategy in strategies.items()
        }
        if self._rewriter.achieved_goal_key in self._mixtures:
            raise ValueError(
                f"strategies must not replace {self._rewriter.achieved_goal_key!r}: "
                "name a new entry"
            )

    @classmethod
    def from_env(  # type: ignore[override]  # the strategies have no default
        cls,
        env: envs.EnvBase,
        strategies: Mapping[Any, StrategyOption],
        **options: Any,  # noqa: ANN401
    ) -> Self:
        """Makes the transform with the goal functions of an environment.

        See `BufferTransform.from_env`.
        """
        return super().from_env(env, strategies=strategies, **options)

    def _check_setup(self, batch: TensorDictBase) -> None:
        """Also checks that the new entries replace no entries of the data.

        Raises:
            ValueError: The data have an entry under one of the keys.
        """
        super()._check_setup(batch)
        for key in self._mixtures:
            places = key, unravel_key(("next", key))
            if key != self._rewriter.goal_key and any(
                batch.get(place, None) is not None for place in places
            ):
                raise ValueError(
                    f"strategies must not replace {key!r}, which the data have "
                    "already: name a new entry"
                )

    def _get_mixtures(self) -> Collection[Mixture]:
        return self._mixtures.values()

    def _draw(self, serials: Integers, batch: TensorDictBase) -> dict[NestedKey, Goals]:
        """Draws a goal for each row and key, (n, *goal)."""
        # A unit is a row or a slice. It gets one goal, which is drawn for its last row.
        last_serials, units = self._find_units(serials)
        oldest = self._memory.oldest
        drawn = {}
        # Another thread may have overwritten rows since they were sampled. `clip` keeps
        # their serial numbers valid. The goals drawn for these rows are wrong, and are
        # replaced below.
        for key, mixture in self._mixtures.items():
            goals = self._memory.draw(
                last_serials.clip(oldest), mixture, self._generator
            )
            drawn[key] = goals if units is None else goals[units]
        # Give the overwritten rows the goals that they achieved.
        is_forgotten = serials < oldest
        if is_forgotten.any():
            achieved = batch.get(self._rewriter.next_achieved_key)
            for goals in drawn.values():
                goals[is_forgotten] = achieved.numpy(force=True)[is_forgotten]
        return drawn

    def _write(self, batch: TensorDictBase, drawn: dict[NestedKey, Goals]) -> None:
        stored_goals = batch.get(self._rewriter.goal_key)
        goals = {
            key: torch.from_numpy(values).to(stored_goals)
            for key, values in drawn.items()
        }
        rows = torch.arange(len(batch), device=stored_goals.device)
        first_goals = next(iter(goals.values()))
        values = self._rewriter.evaluate(batch, rows, first_goals)
        for key, new in goals.items():
            values |= {key: new, unravel_key(("next", key)): new.clone()}
        for key, new in values.items():
            batch.set(key, new)
