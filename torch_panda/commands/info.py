"""Print what is installed, and what it offers."""

from collections.abc import Sequence

from torch_panda.info import describe


def run(arguments: Sequence[str]) -> None:
    """Print the description; there are no options."""
    if arguments:
        raise SystemExit(f"info takes no options, got {' '.join(arguments)}")
    print(describe())
