"""The option ``--import``: modules of the user, which register ids for a command."""

import importlib
import sys
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import Annotated

import tyro

from torch_panda.extras import explain_missing

Imports = Annotated[
    tuple[str, ...],
    tyro.conf.arg(name="import", metavar="MODULE_OR_FILE"),
    tyro.conf.UseAppendAction,
]
"""The type of the option ``--import``, which may be given several times."""


def import_modules(names: Iterable[str]) -> None:
    """Import the arguments of ``--import``, also from the current folder.

    A .py file becomes a module that is named after it, so that its classes can be
    pickled. An error inside a module is not caught.

    Raises:
        ValueError: There is no such module or file, or a file would replace a module
            that is loaded.
    """
    folder = str(Path.cwd())
    if folder not in sys.path:  # a console script has its own folder there instead
        sys.path.insert(0, folder)
    for name in names:
        if name.endswith(".py"):
            _run_file(name)
            continue
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as error:
            if error.name is None or not f"{name}.".startswith(f"{error.name}."):
                raise  # the user's module exists, but imports a missing module
            raise ValueError(
                explain_missing(error)
                or f"cannot import {name!r}: there is no such module; --import takes "
                "the name of a module or the path of a .py file"
            ) from None


def _run_file(file: str) -> None:
    """Run a file as a module. The file itself may have been loaded before."""
    try:
        source = Path(file).read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"cannot import the file {file}: {error}") from None
    name = Path(file).stem
    if name in sys.modules:
        loaded = getattr(sys.modules[name], "__file__", None)
        if loaded is None or Path(loaded).resolve() != Path(file).resolve():
            raise ValueError(
                f"cannot import the file {file}: another module named {name!r} is "
                "loaded; rename the file"
            )
    module = ModuleType(name)
    module.__file__ = file
    sys.modules[name] = module
    exec(compile(source, file, "exec"), module.__dict__)
