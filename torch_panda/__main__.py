"""``python -m torch_panda bench`` and ``python -m torch_panda info``."""

import argparse
import sys
from collections.abc import Sequence

from torch_panda.info import describe


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command; None takes the arguments of the process."""
    arguments = sys.argv[1:] if arguments is None else arguments
    parser = argparse.ArgumentParser(
        prog="python -m torch_panda",
        description="Goal-conditioned Franka Panda tasks, stepped in threads.",
    )
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("info", help="versions, environments, threads, renderers")
    commands.add_parser(
        "bench",
        add_help=False,
        help="steps per second beside other vector environments, in turns",
    )
    command, rest = parser.parse_known_args(arguments)
    if command.command == "info":
        print(describe())
        return
    # Here: it imports libraries of the extra `learning`.
    from torch_panda.bench import main as run_bench

    run_bench(rest)


if __name__ == "__main__":
    main()
