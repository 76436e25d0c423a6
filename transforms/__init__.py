"""Hindsight goal relabelling for any goal-conditioned TorchRL pipeline."""

from torch_panda.transforms.relabel import HindsightRelabel
from torch_panda.transforms.sampler import GoalSampler

__all__ = ["GoalSampler", "HindsightRelabel"]
