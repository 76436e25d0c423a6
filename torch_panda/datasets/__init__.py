"""Data sets: demonstrations, generated data for offline learning, other formats."""

from torch_panda.datasets.demonstrations import read_demos
from torch_panda.datasets.generation import generate, sha256

__all__ = ["generate", "read_demos", "sha256"]
