"""Rotations."""

NO_ROTATION = (0.0, 0.0, 0.0, 1.0)
