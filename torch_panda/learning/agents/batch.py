"""Batches of transitions as tuples of tensors, which are faster than TensorDicts."""

from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor


class Batch(NamedTuple):
    """Transitions (s, a, s') with goals, named as in the papers.

    Attributes:
        s: Observations before the step, (n, observation size).
        a: Actions, (n, action size).
        r: Rewards for the goal ``g``, (n,). If each part of the goal has a critic of
            its own, a row has a reward for each part, (n, parts).
        ends: Whether the return ends with this step, (n,) bool. Targets of critics then
            have no next value. With an environment, an episode ends for another reason
            than its step limit. With a data set, ``s_next`` reaches the goal ``g``.
        s_next: Observations after the step, (n, observation size).
        g: Goals for the losses of critics and value functions, (n, goal size). They are
            the same before and after the step.
        g_actor: Goals for the losses of the policies, (n, goal size). Only data sets
            have other goals here than in ``g``.
        num_demos: Number of demonstrations, which are the last rows.
        source: The sampled TensorDict without the demonstrations. It also has the
            entries of `Agent.extend`.
    """

    s: Tensor
    a: Tensor
    r: Tensor
    ends: Tensor
    s_next: Tensor
    g: Tensor
    g_actor: Tensor
    num_demos: int
    source: TensorDictBase

    @classmethod
    def from_tensordict(
        cls, batch: TensorDictBase, demos: TensorDictBase | None = None
    ) -> "Batch":
        """Read the transitions from a batch with torchrl's keys.

        Args:
            batch: Transitions of a replay buffer, or of `OfflineData`, (n,).
            demos: Demonstrated transitions, (m,), which are appended.
        """
        rows = cls._read(batch)
        if demos is None:
            return rows
        added = cls._read(demos)
        joined: dict[str, Any] = {
            name: torch.cat((getattr(rows, name), getattr(added, name)))
            for name in cls._fields
            if name not in ("num_demos", "source")
        }
        return rows._replace(**joined, num_demos=len(demos))

    @classmethod
    def _read(cls, batch: TensorDictBase) -> "Batch":
        after = batch.get("next")
        goal = batch.get("desired_goal", None)
        return cls(
            s=batch.get("observation"),
            a=batch.get("action"),
            r=after.get("reward").squeeze(-1),
            ends=after.get("terminated").squeeze(-1),
            s_next=after.get("observation"),
            g=batch.get("value_goal", goal),
            g_actor=batch.get("actor_goal", goal),
            num_demos=0,
            source=batch,
        )
