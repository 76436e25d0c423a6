"""What the networks see: observation and goal, standardised."""

import torch
from torch import Tensor, nn

from torch_panda.learning.geometry import Geometry
from torch_panda.learning.hyperparameters import RelativeInputs

CLIP_OBSERVATION = 200.0  # the panda-gym paper
CLIP_NORMALIZED = 5.0  # OpenAI Baselines' HER
FINE = 0.03  # [m], where "fine" differences are clipped


class Normalizer(nn.Module):
    """Running standardisation of the inputs, as in OpenAI Baselines.

    Args:
        size: of an observation and a goal together.
        geometry: of the task.
        relative_inputs: which differences of positions the networks see, too.
    """

    count: Tensor
    total: Tensor
    total_squared: Tensor
    mean: Tensor
    std: Tensor

    def __init__(
        self, size: int, geometry: Geometry, relative_inputs: RelativeInputs
    ) -> None:
        super().__init__()
        self.geometry, self.relative_inputs = geometry, relative_inputs
        self.heights = [start + 2 for start in geometry.goal_positions]
        kinds = ("none", "coarse", "fine").index(relative_inputs)
        size += len(geometry.later) * kinds
        # The turn's matrix and likenesses.
        size += 9 + 24 if kinds and geometry.orientation is not None else 0
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("total", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("total_squared", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("std", torch.ones(size))

    def update(self, observation: Tensor, goal: Tensor) -> None:
        """Take more rows, (..., size of each), into the statistics."""
        rows = self._inputs(observation, goal).flatten(0, -2).double()
        self.count += len(rows)
        self.total += rows.sum(0)
        self.total_squared += rows.square().sum(0)
        mean = self.total / self.count
        variance = (self.total_squared / self.count - mean.square()).clamp(min=1e-4)
        self.mean.copy_(mean)
        self.std.copy_(variance.sqrt())

    def forward(self, observation: Tensor, goal: Tensor) -> Tensor:
        """Standardise (..., size of each) to (..., size)."""
        normalized = (self._inputs(observation, goal) - self.mean) / self.std
        return normalized.clamp_(-CLIP_NORMALIZED, CLIP_NORMALIZED)

    def _inputs(self, observation: Tensor, goal: Tensor) -> Tensor:
        inputs = [observation, goal]
        if self.relative_inputs != "none":
            geometry = self.geometry
            if geometry.goal_height is not None:
                goal = goal.clone()
                goal[..., self.heights] = geometry.goal_height
            differences = geometry.differences(observation, goal)
            inputs = [observation, goal, differences]
            if geometry.orientation is not None:
                inputs = [*geometry.turns(observation, goal), differences]
            if self.relative_inputs == "fine":
                inputs.append(differences.clamp(-FINE, FINE))
        return torch.cat(inputs, -1).clamp_(-CLIP_OBSERVATION, CLIP_OBSERVATION)
