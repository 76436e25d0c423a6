"""Helpers of the tests that train."""

import csv


class After:
    """A stop signal that becomes true when it is asked for the n-th time."""

    def __init__(self, number):
        self.left = number

    def __bool__(self):
        self.left -= 1
        return self.left < 0


def read_curve(folder):
    """The rows of a run's curve.csv."""
    with (folder / "curve.csv").open() as file:
        return list(csv.DictReader(file))
