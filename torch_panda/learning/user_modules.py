"""The option ``--import``: modules of the user, which register ids for a command."""

import importlib
import sys
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import Annotated, NamedTuple

import tyro

Imports = Annotated[
    tuple[str, ...],
    tyro.conf.arg(name="import", metavar="MODULE_OR_FILE"),
    tyro.conf.UseAppendAction,
]
"""The type of the option ``--import``, which may be given several times."""


class UserModule(NamedTuple):
    """A module to import, in this process or in another one.

    Attributes:
        name: Dotted name of a module, or path of a .py file.
        source: Content of the .py file, so that other machines can run it without the
            file. None for the name of a module.
    """

    name: str
    source: str | None


def read_modules(names: Iterable[str]) -> tuple[UserModule, ...]:
    """Read the files among the arguments of ``--import``.

    Raises:
        ValueError: A file does not exist or is not text.
    """
    modules = []
    for name in names:
        source = None
        if name.endswith(".py"):
            try:
                source = Path(name).read_text()
            except (OSError, UnicodeDecodeError) as error:
                raise ValueError(f"cannot import the file {name}: {error}") from None
        modules.append(UserModule(name, source))
    return tuple(modules)


def import_modules(modules: Iterable[UserModule]) -> None:
    """Import modules in this process, also from the current folder.

    A file becomes a module that is named after it, so that its classes can be pickled.
    An error inside a module is not caught.

    Raises:
        ValueError: There is no module of that name, or a file would replace a module
            that is loaded.
    """
    folder = str(Path.cwd())
    if folder not in sys.path:  # a console script has its own folder there instead
        sys.path.insert(0, folder)
    for name, source in modules:
        if source is None:
            try:
                importlib.import_module(name)
            except ModuleNotFoundError as error:
                if error.name is None or not f"{name}.".startswith(f"{error.name}."):
                    raise  # the user's module exists, but imports a missing module
                raise ValueError(
                    f"cannot import {name!r}: there is no such module; --import takes "
                    "the name of a module or the path of a .py file"
                ) from None
        else:
            _run_file(name, source)


def _run_file(file: str, source: str) -> None:
    """Run a file as a module. The file itself may have been loaded before."""
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
