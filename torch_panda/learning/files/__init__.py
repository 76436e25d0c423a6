"""Files of tensors and numbers, which are written atomically and read safely."""

import os
import zipfile
from collections.abc import Callable, Iterable, Mapping
from functools import reduce
from operator import getitem
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, BinaryIO

import torch
from tensordict import NestedKey
from torch import Tensor


def prepare(path: Path) -> None:
    """Make the folder of a file, and check that the file can be written.

    Raises:
        OSError: The file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir() or not os.access(path.parent, os.W_OK):
        raise OSError(f"cannot write to {path}")


def replace(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Replace a file atomically: even if the process is killed, no half file remains.

    The new content is written into a temporary file, which is then renamed.

    Args:
        path: The file.
        write: Function that writes the content into an open file.

    Raises:
        OSError: The content cannot be written, for example because the disk is full.
            The old file is kept.
    """
    temporary = path.with_name(path.name + ".new")
    try:
        with temporary.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except (OSError, RuntimeError) as error:  # torch raises a RuntimeError
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise OSError(
            f"cannot write {path.name} into {path.parent}: {reason}"
        ) from None
    finally:
        temporary.unlink(missing_ok=True)


def save(path: Path, content: object) -> None:
    """Write tensors, numbers, strings and dicts of these into a file.

    Raises:
        OSError: The file cannot be written.
    """
    replace(path, lambda file: torch.save(content, file))


def save_text(path: Path, text: str) -> None:
    """Write text into a file.

    Raises:
        OSError: The file cannot be written.
    """
    replace(path, lambda file: file.write(text.encode()))


def read(
    path: Path,
    content_name: str,
    keys: Iterable[NestedKey],
    *,
    finite: Iterable[NestedKey] = (),
) -> Any:  # noqa: ANN401 (the content)
    """Read a file that `save` wrote, onto the CPU. Code in the file is not run.

    Args:
        path: The file.
        content_name: Name of the expected content for the error, such as "a policy".
        keys: Keys that the content must have.
        finite: Keys under which all numbers must be finite.

    Raises:
        ValueError: The file is missing or damaged, or lacks a key.
    """
    if not path.exists():
        raise ValueError(f"there is no file {path}")
    try:
        check_archive(path)
        content = torch.load(path, weights_only=True, map_location="cpu")
        for key in keys:
            get(content, key)
        for key in finite:
            check_finite(key, get(content, key))
    except Exception as error:  # damaged bytes can raise almost any exception
        reason = str(error) if isinstance(error, ValueError) else type(error).__name__
        if isinstance(error, UnpicklingError):
            reason = "it may hold only tensors, numbers, strings, dicts and lists"
        raise ValueError(
            f"{path} does not hold {content_name}, or is damaged ({reason})"
        ) from None
    return content


def get(content: Any, key: NestedKey) -> Any:  # noqa: ANN401 (nested dicts)
    """Return the value under a key, which may be a tuple of nested keys.

    Raises:
        ValueError: There is no such value.
    """
    try:
        return reduce(getitem, key if isinstance(key, tuple) else (key,), content)
    except (LookupError, TypeError):
        raise ValueError(f"there is no entry {key!r}") from None


def check_archive(path: Path) -> None:
    """Verify the checksums of a file of `torch.save`, which `torch.load` does not do.

    Raises:
        ValueError: The checksums differ, or the file is not such an archive.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
    except (zipfile.BadZipFile, NotImplementedError):
        raise ValueError("not an archive of torch.save") from None
    if damaged is not None:
        raise ValueError(f"wrong checksum of {damaged}")


def check_finite(name: NestedKey, values: object) -> None:
    """Check that all numbers in tensors and nested dicts and lists are finite.

    Raises:
        ValueError: A number is infinite or not a number.
    """
    if isinstance(values, Mapping):
        values = list(values.values())
    if isinstance(values, list | tuple):
        for value in values:
            check_finite(name, value)
    elif (
        isinstance(values, Tensor | float)
        and not torch.as_tensor(values).isfinite().all()
    ):
        raise ValueError(f"{name} has numbers that are not finite")
