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
    bench = commands.add_parser(
        "bench",
        help="steps per second beside those of others, in turns in one run",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    if "bench" not in arguments:
        parser.parse_args(arguments)
        print(describe())
        return
    # Here: it imports what nothing else in the package needs.
    from torch_panda.bench import command

    command.add_options(bench)
    command.run(parser.parse_args(arguments))


if __name__ == "__main__":
    main()
