"""What is kept of an environment: pickles and state dicts."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from torchrl.envs import EnvBase

from torch_panda.envs.episodes import Episodes

if TYPE_CHECKING:
    from torch_panda.envs.robot_task import RobotTaskEnv


class PersistentEnv(EnvBase):
    """An environment that can be copied, and whose run can be resumed.

    It pickles as its class and arguments, a subclass's own too: physics cannot be
    copied, so a copy builds its own, and draws what the last seed for all environments
    lets it draw. Its ``state_dict`` holds seeds and numbers of episodes. When it is
    forgotten, it is closed at once.
    """

    episodes: Episodes
    _arguments: tuple[tuple[Any, ...], dict[str, Any]]

    def __new__(cls, *args: Any, **kwargs: Any) -> Any:  # noqa: ANN401 (a subclass's)
        """Remember the arguments."""
        env = super().__new__(cls, *args, **kwargs)
        env._arguments = (args, kwargs)
        return env

    def __reduce__(self) -> tuple[Any, ...]:
        seed = self.episodes.seeds.seed
        return _rebuild, (type(self), *self._arguments, seed, self.device)

    def _create_done_specs(self) -> None:
        # They are complete. torchrl's method leaves a cycle of references behind, which
        # keeps a forgotten environment alive until the garbage collector finds it.
        pass

    def get_extra_state(self) -> dict[str, Any]:
        """Seeds and numbers of episodes, which ``state_dict`` holds."""
        return self.episodes.seeds.state()

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Draw the episodes that follow those of a ``state_dict``."""
        self.episodes.seeds.load(state)

    def load_state_dict(
        self,
        state_dict: Mapping[str, Any],
        *args: Any,  # noqa: ANN401 (torch's signature)
        **kwargs: Any,  # noqa: ANN401
    ) -> object:
        """Load a ``state_dict``; nothing if it is empty.

        torchrl's collectors leave an environment's own state out of theirs.

        Raises:
            ValueError: it is of another number of environments.
        """
        if not state_dict:
            return None
        return super().load_state_dict(state_dict, *args, **kwargs)


def _rebuild(
    kind: "type[RobotTaskEnv]",
    args: tuple[Any, ...],
    kwargs: dict[str, Any],
    seed: int | None,
    device: torch.device,
) -> "RobotTaskEnv":
    env = kind(*args, **kwargs)
    env.episodes.seeds.restart(seed)
    return env.to(device)
