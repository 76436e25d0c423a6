"""Standardised inputs of the networks: observation, goal, and relative inputs."""

import torch
from torch import Tensor, nn

from torch_panda.learning.agents.hyperparameters import RelativeInputs
from torch_panda.learning.environments.geometry import split_goal
from torch_panda.learning.environments.spaces import Spaces

CLIP_OBSERVATION = 200.0  # from the panda-gym paper
CLIP_NORMALIZED = 5.0  # from the HER of OpenAI Baselines
OTHERS = 0.1  # weight of the numbers of other objects in `part_weights`
FINE_LIMIT = 0.03  # "fine" inputs are offsets, clipped to this distance per axis [m]


class Normalizer(nn.Module):
    """Subtracts the running mean and divides by the deviation, like OpenAI Baselines.

    Args:
        spaces: Sizes and layout of observations and goals.
        relative_inputs: Which offsets between positions are inputs too; see
            `Hyperparameters.relative_inputs`.

    Attributes:
        goal_columns: Columns of the inputs that hold the goal.
        state_columns: Columns of the inputs that do not depend on the goal.
        num_copies: Number of copies of the offsets among the inputs.
        mean: Mean of each input, (state size,).
        std: Standard deviation of each input, at least 0.01, (state size,).
    """

    state_columns: Tensor
    count: Tensor
    total: Tensor
    total_squared: Tensor
    mean: Tensor
    std: Tensor

    def __init__(self, spaces: Spaces, relative_inputs: RelativeInputs) -> None:
        super().__init__()
        geometry = spaces.geometry
        size = spaces.observation_size + spaces.goal_size
        self.num_copies = 0
        state_columns = [*range(spaces.observation_size)]
        self.goal_columns = slice(spaces.observation_size, size)
        if geometry is not None:
            self.num_copies = ("none", "coarse", "fine").index(relative_inputs)
            if self.num_copies and geometry.orientation is not None:
                # The matrix and the similarities of `Geometry.rotations`.
                size += 9 + 24
            for _ in range(self.num_copies):
                state_columns += [
                    size + column
                    for column, point in enumerate(geometry.points)
                    if point < spaces.observation_size
                ]
                size += len(geometry.points)
        self.register_buffer(
            "state_columns", torch.tensor(state_columns), persistent=False
        )
        self.geometry, self.relative_inputs = geometry, relative_inputs
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("total", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("total_squared", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("std", torch.ones(size))

    def update(self, observation: Tensor, goal: Tensor) -> None:
        """Add observations and goals, (..., size) each, to the statistics."""
        rows = self._inputs(observation, goal).flatten(0, -2).double()
        self.count += len(rows)
        self.total += rows.sum(0)
        self.total_squared += rows.square().sum(0)
        mean = self.total / self.count
        variance = (self.total_squared / self.count - mean.square()).clamp(min=1e-4)
        self.mean.copy_(mean)
        self.std.copy_(variance.sqrt())

    def forward(self, observation: Tensor, goal: Tensor) -> Tensor:
        """Standardise observations and goals, (..., size) each.

        Returns:
            ``(..., state size)``.
        """
        normalized = (self._inputs(observation, goal) - self.mean) / self.std
        return normalized.clamp(-CLIP_NORMALIZED, CLIP_NORMALIZED)

    def state(self, observation: Tensor) -> Tensor:
        """Standardise observations (..., size) and the offsets that need no goal.

        Returns:
            ``(..., len(self.state_columns))``.
        """
        size = self.goal_columns.stop - self.goal_columns.start
        goal = observation.new_zeros((*observation.shape[:-1], size))
        return self(observation, goal)[..., self.state_columns]

    def goal(self, goal: Tensor) -> Tensor:
        """Standardise goals (..., size). Orientations stay as they are."""
        if self.geometry is not None and self.geometry.orientation is not None:
            return goal
        columns = self.goal_columns
        normalized = (goal - self.mean[columns]) / self.std[columns]
        return normalized.clamp(-CLIP_NORMALIZED, CLIP_NORMALIZED)

    def part_weights(self) -> Tensor:
        """Weights of a state's numbers for the critic of each part of a goal.

        The numbers of the part's own object have the weight 1, and so have numbers that
        describe no object, such as the hand's position. The numbers of the other
        objects have the weight `OTHERS`.

        Returns:
            ``(parts, state size)``.
        """
        first = self.goal_columns.start
        parts = split_goal(self.goal_columns.stop - first)
        weights = torch.ones(len(parts), len(self.mean))
        if self.geometry is None:
            return weights
        inputs, offsets = self.geometry.owners()
        owners = inputs + self.num_copies * offsets
        for part, row in zip(parts, weights, strict=True):
            for column, owner in enumerate(owners):
                if owner not in (None, owners[first + part.start]):
                    row[column] = OTHERS
        return weights

    def _inputs(self, observation: Tensor, goal: Tensor) -> Tensor:
        """Concatenate observation, goal and relative inputs, (..., state size)."""
        inputs = [observation, goal]
        geometry = self.geometry
        if geometry is not None and self.relative_inputs != "none":
            if geometry.goal_height is not None:
                goal = goal.clone()
                for start in geometry.goal_positions:
                    goal[..., start + 2].fill_(geometry.goal_height)
            differences = geometry.differences(observation, goal)
            inputs = [observation, goal, differences]
            if geometry.orientation is not None:
                inputs = [*geometry.rotations(observation, goal), differences]
            if self.relative_inputs == "fine":
                inputs.append(differences.clamp(-FINE_LIMIT, FINE_LIMIT))
        return torch.cat(inputs, -1).clamp(-CLIP_OBSERVATION, CLIP_OBSERVATION)
