"""TensorSpecs of an environment."""

import torch
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded

from torch_panda.envs.episodes import Episodes
from torch_panda.sensors import Entry


class Specs:
    """Specs of a batch of environments.

    They follow from the sizes that the robot, the task and the sensors declare.

    Args:
        episodes: The environments.
        device: Device of the tensors.
        observe_state: Whether the observed entries include ``observation``.
    """

    def __init__(
        self, episodes: Episodes, device: torch.device, *, observe_state: bool
    ) -> None:
        self._batch = torch.Size(episodes.batch_shape)
        self._device = device
        robot, task = episodes.robot, episodes.task
        observed: dict[str, TensorSpec] = {
            "achieved_goal": self._numbers(episodes.goal_dim),
            "desired_goal": self._numbers(episodes.goal_dim),
            "success": self._flag(),
        }
        if observe_state:
            size = robot.observation_dim + task.observation_dim
            observed["observation"] = self._numbers(size)
        for key, entry in episodes.entries.items():
            observed[key] = self._entry(entry)
        self.observation = Composite(observed, shape=self._batch, device=device)
        self.action = Bounded(
            low=-1.0,
            high=1.0,
            shape=torch.Size((*self._batch, robot.action_dim)),
            device=device,
            dtype=torch.float32,
        )
        self.reward = self._numbers(1)
        self.done = Composite(
            {key: self._flag() for key in ("done", "terminated", "truncated")},
            shape=self._batch,
            device=device,
        )

    def _numbers(self, size: int) -> TensorSpec:
        return self._entry(Entry((size,), torch.float32))

    def _flag(self) -> TensorSpec:
        return self._entry(Entry((1,), torch.bool))

    def _entry(self, entry: Entry) -> TensorSpec:
        shape, dtype = torch.Size((*self._batch, *entry.shape)), entry.dtype
        if dtype == torch.bool:
            return Binary(shape=shape, device=self._device, dtype=dtype)
        if entry.high is None:
            return Unbounded(shape, dtype=dtype, device=self._device)
        return Bounded(0, entry.high, shape, dtype=dtype, device=self._device)
