"""Hindsight goal relabelling for any goal-conditioned TorchRL pipeline."""

from torch_panda.transforms.hindsight import GoalSampler, HindsightRelabel

__all__ = ["GoalSampler", "HindsightRelabel"]
