"""Hindsight goal relabelling for any goal-conditioned TorchRL pipeline."""

from .relabel import HindsightRelabel

__all__ = ["HindsightRelabel"]
