"""``python -m torch_panda bench`` and ``python -m torch_panda info``."""

import argparse
from collections.abc import Sequence

from torch_panda.bench import command as bench
from torch_panda.info import describe


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command; None takes the arguments of the process."""
    parser = argparse.ArgumentParser(
        prog="python -m torch_panda",
        description="Goal-conditioned Franka Panda tasks, stepped in threads.",
    )
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("info", help="versions, environments, threads, renderers")
    bench.add_options(
        commands.add_parser(
            "bench",
            help="steps per second beside those of others, in turns in one run",
            formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        )
    )
    args = parser.parse_args(arguments)
    if args.command == "info":
        print(describe())
    else:
        bench.run(args)


if __name__ == "__main__":
    main()
