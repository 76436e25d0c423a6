"""Hindsight goals at write time, as a transform of a replay buffer."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase

from torch_panda.transforms.buffer_only import BufferTransform
from torch_panda.transforms.rewrite import GoalFunction
from torch_panda.transforms.strategies import (
    RANDOM,
    Strategy,
    choose_steps,
)
from torch_panda.transforms.trajectories import TRAJECTORY_KEY, split_runs, streams_of


class HindsightAugment(BufferTransform):
    """Stores every transition once more for each of k goals achieved in its episode.

    The paper's own way (Andrychowicz et al. 2017, arXiv 1707.01495, algorithm 1): "for
    each stored transition, it stores k identical transitions with a different goal".
    An episode is held back until it ends; then `extend` stores its transitions and k
    relabelled copies of each, k + 1 times the memory of `HindsightRelabel`, which draws
    new goals at every sample instead. What comes out is flat: the storage must have
    one dimension, and be written with `extend`, not `add`. An episode that never ends
    is never stored, and the copies keep the original's trajectory id, so trajectories
    cannot be told apart in the buffer.

    An episode has ended also where a later row of its id does not begin at the goal
    that was achieved last. If the data lack the root achieved goal, or it is never
    what the step before achieved, the id alone decides: call `end_trajectories` before
    data of a new collector, whose ids begin anew. Loading a saved buffer does so.

    Args:
        reward_fn: as in `HindsightRelabel`, called once an `extend`.

    Keyword Args:
        k: number of relabelled copies of a transition.
        strategy: "future", "final", "episode", or a function, see `strategies`;
            "random" would need the other episodes: `HindsightRelabel` has it.
        goal_key: the desired goal, rewritten in the root and under "next".
        achieved_goal_key: the achieved goal, read under "next" and, if there, in the
            root.
        reward_key: the reward.
        terminated_fn: as in `HindsightRelabel`.
        trajectory_key: as in `HindsightRelabel`.
        single_env: takes 1-d data without ids for consecutive steps of one
            environment.
        seed: seeds a generator of its own. By default torch's is used.

    Raises:
        ValueError: an argument is out of range; the data do not tell which trajectory a
            transition belongs to, or come from `add`; a function returned the wrong
            shape; the transform is put into an environment.
        KeyError: the data lack an entry that is needed.
        RuntimeError: the buffer is shared between processes, or the transform combined
            with `MultiStepTransform`.
    """

    def __init__(
        self,
        reward_fn: GoalFunction,
        *,
        k: int = 4,
        strategy: str | Strategy = "future",
        goal_key: NestedKey = "desired_goal",
        achieved_goal_key: NestedKey = "achieved_goal",
        reward_key: NestedKey = ("next", "reward"),
        terminated_fn: GoalFunction | None = None,
        trajectory_key: NestedKey = TRAJECTORY_KEY,
        single_env: bool = False,
        seed: int | None = None,
    ) -> None:
        super().__init__(
            reward_fn,
            strategy=strategy,
            goal_key=goal_key,
            achieved_goal_key=achieved_goal_key,
            reward_key=reward_key,
            terminated_fn=terminated_fn,
            trajectory_key=trajectory_key,
            single_env=single_env,
            seed=seed,
        )
        if k < 1 or not float(k).is_integer():
            raise ValueError(f"k must be an integer of at least 1, got {k}.")
        if strategy == RANDOM:
            raise ValueError(
                "HindsightAugment sees one episode at a time and cannot draw "
                f"{RANDOM!r} goals; HindsightRelabel can."
            )
        self.k = k
        # stream -> parts of its episode
        self._held: dict[int, list[TensorDictBase]] = {}
        self._over = False  # whether what is held goes no further
        # Whether a row's root was ever what the row before it achieved.
        self._linked = False

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase | None:
        """Takes transitions in and returns those of the episodes that have ended."""
        self._check_chain()
        if not tensordict.ndim:
            raise ValueError(
                "HindsightAugment stores many transitions at once, which `add` takes "
                "for one item: use `extend`, with data of shape [1] for a single one."
            )
        self._rewriter.check(tensordict)
        shape = tensordict.batch_size
        streams = streams_of(tensordict, self.trajectory_key, self.single_env)
        if len(shape) > 1:  # time first, as the streams are
            tensordict = tensordict.permute(len(shape) - 1, *range(len(shape) - 1))
        flat = tensordict.reshape(-1)
        stream = streams.cpu().numpy()
        done = flat.get(("next", "done")).reshape(-1).cpu().numpy()
        order = stream.argsort(kind="stable")
        runs = split_runs(stream[order], done[order])
        rows = torch.from_numpy(order).split(runs.length.tolist())
        episodes = []
        if self._over:
            episodes = [TensorDict.cat(parts) for parts in self._held.values()]
            self.empty()
        for name, ended, part in zip(runs.stream, runs.ended, rows, strict=True):
            new = flat[part]
            if name in self._held and self._begins_anew(new, self._held[name][-1]):
                episodes.append(TensorDict.cat(self._held.pop(name)))
            self._held.setdefault(name, []).append(new)
            if ended:
                episodes.append(TensorDict.cat(self._held.pop(name)))
        if not episodes:
            return None
        return self._augment(episodes)

    def _begins_anew(self, new: TensorDictBase, held: TensorDictBase) -> bool:
        """Tells whether new rows do not begin where the rows held back got to."""
        root = new.get(self._rewriter.achieved_goal_key, None)
        if root is None:
            return False
        achieved = held.get(self._rewriter.next_achieved_key)
        goes_on = torch.equal(root[0], achieved[-1])
        if not self._linked:
            held_root = held.get(self._rewriter.achieved_goal_key, achieved)
            links = (held_root[1:] == achieved[:-1]).flatten(1).all(1)
            self._linked = goes_on or bool(links.any())
        return self._linked and not goes_on

    def _augment(self, episodes: list[TensorDictBase]) -> TensorDictBase:
        """Returns the episodes' transitions, then their k relabelled copies."""
        original = TensorDict.cat(episodes)
        achieved = original.get(self._rewriter.next_achieved_key)
        length = np.array([len(e) for e in episodes])
        start = (length.cumsum() - length).repeat(length)
        end = length.repeat(length)
        step = np.arange(len(original)) - start
        step, start, end = (np.tile(x, self.k) for x in (step, start, end))
        share = torch.rand(
            len(step), generator=self._generator, dtype=torch.float64, device="cpu"
        )
        goal_step = choose_steps(
            self.strategy,
            step,
            np.zeros_like(step),
            end,
            share.numpy(),
            self._generator,
        )
        goals = achieved[torch.from_numpy(start + goal_step).to(achieved.device)]
        copies = TensorDict.cat([original] * self.k)
        rows = torch.arange(len(copies), device=achieved.device)
        copies = self._rewriter.rewrite(copies, rows, goals)
        return TensorDict.cat([original, copies])

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Leaves what is sampled as it is."""
        return tensordict

    def end_trajectories(self) -> None:
        """Ends the episodes held back; the next `extend` stores them as they are."""
        self._over = True

    def empty(self) -> None:
        """Drops the episodes held back, which the buffer's own `empty` does not."""
        self._held.clear()
        self._over = False

    def get_extra_state(self) -> dict[str, Any]:
        """Returns the episodes held back and the generator, for `state_dict`."""
        return {
            "held": {
                s: TensorDict.cat(parts).to_dict() for s, parts in self._held.items()
            },
            "over": self._over,
            "generator": self._generator_state(),
        }

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Takes what `get_extra_state` returned."""
        done = ("next", "done")
        self._held = {
            stream: [TensorDict(part, [len(part[done[0]][done[1]])])]
            for stream, part in state["held"].items()
        }
        root = self._rewriter.achieved_goal_key
        self._over = state["over"] or any(
            part.get(root, None) is None for (part,) in self._held.values()
        )
        self._load_generator(state["generator"])

    def __repr__(self) -> str:
        return f"HindsightAugment(k={self.k}, strategy={self.strategy!r})"
