"""Files of tensors and numbers: written whole, and read without running code."""

import os
from collections.abc import Callable, Iterable
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey


def prepare(path: Path) -> None:
    """Make a file's folder, so that what takes long to make will not be lost.

    Raises:
        OSError: the file could not be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir() or not os.access(path.parent, os.W_OK):
        raise OSError(f"cannot write to {path}")


def replace(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file whole or not at all: a kill never leaves half of it."""
    temporary = path.with_name(path.name + ".new")
    write(temporary)
    os.replace(temporary, path)


def save(path: Path, content: object) -> None:
    """Write tensors, numbers and dicts."""
    replace(path, lambda temporary: torch.save(content, temporary))


def read(
    path: Path,
    what: str,
    keys: Iterable[NestedKey],
    **options: Any,  # noqa: ANN401 (those of torch.load)
) -> Any:  # noqa: ANN401 (what was saved)
    """Read a file of tensors, numbers and dicts that torch.save wrote.

    Nothing in it is run, so it may come from a stranger.

    Args:
        path: of the file.
        what: it should hold, for the error.
        keys: that this has.
        options: of torch.load.

    Raises:
        ValueError: it is missing, empty or damaged, or holds something else.
    """
    if not path.exists():
        raise ValueError(f"there is no file {path}")
    try:
        content = torch.load(path, weights_only=True, **options)
        for key in keys:
            reduce(getitem, key if isinstance(key, tuple) else (key,), content)
    except Exception as error:  # of almost any kind: it depends on the bytes
        raise ValueError(
            f"{path} does not hold {what}, or is damaged ({type(error).__name__})"
        ) from None
    return content
