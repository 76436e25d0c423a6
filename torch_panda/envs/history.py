"""Records the start of every episode and the actions since, for exact states.

Bullet remembers more than positions and velocities (see `bullet.broad_phase`). Only
repeating the actions from the start of the episode leads to the same state bit for bit.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_panda.bullet import BulletError

# Keys that an exact state has beside those of a state.
START = "start_"  # prefix of a key of the state
ACTIONS = "actions"
NUM_ACTIONS = "num_actions"

# Number of old steps that are dropped at a time.
_CHUNK = 1000
# Longest episode that has an exact state [steps]. It bounds the memory of episodes that
# never end.
_MAX_STEPS = 20_000
_FORGOTTEN = -1


class History:
    """Starts of the present episodes of n environments, and the actions since.

    Args:
        state: The tensors of the state, (n, ...) by key.
        action_dim: Number of action entries.
    """

    def __init__(self, state: dict[str, Tensor], action_dim: int) -> None:
        self._start = {key: value.clone() for key, value in state.items()}
        self._action_dim = action_dim
        # (n, action_dim) actions, and which environments took them, (n, 1) bool; None
        # means all.
        self._steps: list[tuple[Tensor, Tensor | None]] = []
        # Index in _steps at which each environment's episode began.
        self._begins = [0] * len(next(iter(state.values())))

    def begin(self, envs: Sequence[int], state: dict[str, Tensor]) -> None:
        """Record the starts of new episodes.

        Args:
            envs: Environments whose episodes start.
            state: The tensors of the state, (n, ...) by key.
        """
        for key, start in self._start.items():
            # As arrays: indexing tensors takes three times as long.
            start.numpy()[envs] = state[key].numpy()[envs]
        for env in envs:
            self._begins[env] = len(self._steps)
        if (unused := min(self._begins)) > _CHUNK:
            del self._steps[:unused]
            self._begins = [begin - unused for begin in self._begins]

    def record(self, action: Tensor, stepped: Tensor | None) -> None:
        """Record a step.

        Args:
            action: (n, action_dim) float32. The caller must not change it later.
            stepped: Which environments take the step, (n, 1) bool; None means all.
        """
        if len(self._steps) == _MAX_STEPS:
            self._steps = []
            self._begins = [_FORGOTTEN] * len(self._begins)
        self._steps.append((action, None if stepped is None else stepped.clone()))

    def export(self) -> dict[str, Tensor]:
        """The recorded starts and actions.

        Returns:
            The starts under keys with the prefix ``start_``, ``actions`` (n, k,
            action_dim) and ``num_actions`` (n, 1). The first ``num_actions[i]`` actions
            of row i are those of environment i; the rest is zero.

        Raises:
            BulletError: An episode is too long for its actions to be kept.
        """
        if forgotten := [i for i, begin in enumerate(self._begins) if begin < 0]:
            raise BulletError(
                f"the episodes of environments {forgotten} are too long for an exact "
                f"state, which holds at most {_MAX_STEPS} actions"
            )
        begins = torch.tensor(self._begins, device="cpu")
        first = int(begins.min())
        steps = self._steps[first:]
        took_step = [
            (begins <= index)
            if stepped is None
            else (begins <= index) & stepped.flatten()
            for index, (_, stepped) in enumerate(steps, start=first)
        ]
        counts = torch.zeros(len(begins), dtype=torch.int64, device="cpu")
        longest = int(sum(took_step, start=counts).max())
        shape = (len(begins), longest, self._action_dim)
        actions = torch.zeros(shape, dtype=torch.float32, device="cpu")
        for (action, _), mask in zip(steps, took_step, strict=True):
            rows = mask.nonzero().flatten()
            actions[rows, counts[rows]] = action[rows]
            counts[rows] += 1
        start = {START + key: value.clone() for key, value in self._start.items()}
        return {**start, ACTIONS: actions, NUM_ACTIONS: counts.unsqueeze(1)}
