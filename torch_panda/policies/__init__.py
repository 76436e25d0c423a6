"""Trained policies that ship with the package; see its README."""

from pathlib import Path

FOLDER = Path(__file__).parent
"""The folder of the files, ``{env_id}.pt``."""
