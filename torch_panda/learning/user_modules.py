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
        ValueError: There is no module of that name.
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
            module = ModuleType(Path(name).stem)
            module.__file__ = name
            sys.modules[module.__name__] = module
            exec(compile(source, name, "exec"), module.__dict__)
