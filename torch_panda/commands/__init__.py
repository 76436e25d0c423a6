"""The commands of ``python -m torch_panda``. Each command is a module of this folder.

A command's module is imported only when the command runs, because it may need libraries
that the environments do not need. Its function ``run`` reads the options from the
command line.
"""

import os
import sys
from collections.abc import Sequence
from importlib import import_module

from torch_panda.extras import explain_missing

# Descriptions of the commands by name.
COMMANDS = {
    "train": "train an agent with hindsight experience replay",
    "evaluate": "measure how often a policy succeeds",
    "watch": "record a policy as a video, or show it in a window or browser",
    "record": "record demonstrations of a scripted expert",
    "plot": "draw the success curves of runs",
    "distributed": "train on the machines of a Ray cluster",
    "bench": "compare the speed with other environments",
    "info": "print versions, environments, threads and renderers",
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command.

    Args:
        arguments: Name and options of the command; None takes them from the command
            line.
    """
    arguments = [
        expand_home(x) for x in (sys.argv[1:] if arguments is None else arguments)
    ]
    name = arguments[0] if arguments else "--help"
    if name in ("-h", "--help"):
        print(describe())
        return
    if name not in COMMANDS:
        raise SystemExit(f"unknown command {name!r}\n\n{describe()}")
    try:
        import_module(f"torch_panda.commands.{name}").run(arguments[1:])
    except ModuleNotFoundError as error:
        explanation = explain_missing(error)
        if explanation is None:
            raise
        raise SystemExit(explanation) from None
    except KeyboardInterrupt:
        raise SystemExit("interrupted") from None


def expand_home(argument: str) -> str:
    """Replace the ~ of a path, which shells leave unchanged in ``--out=~/run``."""
    is_option = argument.startswith("--")
    option, equals, value = argument.partition("=") if is_option else ("", "", argument)
    return option + equals + os.path.expanduser(value)


def describe() -> str:
    """Return the usage, with a line for each command."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name:{width}}  {text}" for name, text in COMMANDS.items()]
    usage = "usage: python -m torch_panda COMMAND [OPTIONS]"
    hint = "python -m torch_panda COMMAND --help lists the options of a command"
    return "\n".join([usage, "", "commands:", *lines, "", hint])
