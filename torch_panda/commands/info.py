"""Print the installed versions, the ids of environments, and the renderers."""

from collections.abc import Sequence

from torch_panda.info import describe


def run(arguments: Sequence[str]) -> None:
    """Print the information. The command has no options."""
    if arguments:
        raise SystemExit(f"info takes no options, got {' '.join(arguments)}")
    print(describe())
