"""How every environment came to its state: the start of its episode, and the actions.

Bullet remembers more than a state holds (see `bullet.broad_phase`), so only a start and
the actions since lead back to a state bit for bit.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_panda.bullet import BulletError

# Keys of an exact state beside those of a state.
START = "start_"  # followed by a key of the state
ACTIONS = "actions"
NUM_ACTIONS = "num_actions"

# Steps that all environments have left behind are dropped in pieces of this size.
_PIECE = 1000
# Longer episodes have no exact state: some end never, and would take all memory.
_MOST = 20_000  # steps
_LOST = -1


class History:
    """Starts of the present episodes, and the actions since.

    Args:
        state: the tensors that hold the state, (n, ...).
        action_dim: number of action entries.
    """

    def __init__(self, state: dict[str, Tensor], action_dim: int) -> None:
        self._start = {key: value.clone() for key, value in state.items()}
        self._action_dim = action_dim
        # Actions of all, (n, action_dim), and who took them: (n, 1) bool, or None: all.
        self._steps: list[tuple[Tensor, Tensor | None]] = []
        self._begun = [0] * len(next(iter(state.values())))  # in _steps

    def begin(self, envs: Sequence[int], state: dict[str, Tensor]) -> None:
        """Episodes start in these environments, from these tensors (n, ...)."""
        for key, start in self._start.items():
            # As arrays: to index tensors takes three times as long.
            start.numpy()[envs] = state[key].numpy()[envs]
        for env in envs:
            self._begun[env] = len(self._steps)
        if (past := min(self._begun)) > _PIECE:
            del self._steps[:past]
            self._begun = [begun - past for begun in self._begun]

    def append(self, action: Tensor, stepped: Tensor | None) -> None:
        """A step was taken.

        Args:
            action: (n, action_dim) float32, which nobody changes later.
            stepped: which environments took it, (n, 1) bool; None: all.
        """
        if len(self._steps) == _MOST:
            self._steps = []
            self._begun = [_LOST] * len(self._begun)
        self._steps.append((action, None if stepped is None else stepped.clone()))

    def export(self) -> dict[str, Tensor]:
        """Starts, ``actions`` (n, most, action_dim) and ``num_actions`` (n, 1).

        Of environment i the first ``num_actions[i]`` actions count; the rest are zero.

        Raises:
            BulletError: an episode has been so long that its actions are forgotten.
        """
        if lost := [env for env, begun in enumerate(self._begun) if begun == _LOST]:
            raise BulletError(
                f"the episodes of environments {lost} are too long for an exact state, "
                f"which holds at most {_MOST} actions"
            )
        begun = torch.tensor(self._begun, device="cpu")
        first = int(begun.min())
        taken = [
            (begun <= index)
            if stepped is None
            else (begun <= index) & stepped.flatten()
            for index, (_, stepped) in enumerate(self._steps[first:], start=first)
        ]
        counts = torch.zeros(len(begun), dtype=torch.int64, device="cpu")
        most = int(sum(taken, start=counts).max())
        shape = (len(begun), most, self._action_dim)
        actions = torch.zeros(shape, dtype=torch.float32, device="cpu")
        for (action, _), who in zip(self._steps[first:], taken, strict=True):
            rows = who.nonzero().flatten()
            actions[rows, counts[rows]] = action[rows]
            counts[rows] += 1
        start = {START + key: value.clone() for key, value in self._start.items()}
        return {**start, ACTIONS: actions, NUM_ACTIONS: counts.unsqueeze(1)}
