"""Demonstrations and data sets: recording, reading, and the formats of other tools."""

from torch_panda.datasets.demonstrations import read_demos

__all__ = ["read_demos"]
