"""A client of Bullet: its handle, and the commands that it submits."""

from collections.abc import Sequence
from ctypes import Array, c_double

import numpy as np
import numpy.typing as npt
from typing_extensions import Self

from torch_panda.bullet import capi


class BulletError(RuntimeError):
    """Bullet refused a command, or a simulation was used as it must not be."""


class Connection:
    """The owner of a client's handle.

    A client must be used by one thread at a time. Clients of one process are
    independent: in different threads they work in parallel.

    Raises:
        BulletError: Bullet could not create a client.
    """

    def __init__(self) -> None:
        self._handle: int | None = self._connect()
        if not self._handle:
            raise BulletError("Bullet could not create a client")

    def _connect(self) -> int | None:
        """Make a world, and return the handle by which Bullet knows the client."""
        handle: int | None = capi.connect_direct()
        return handle

    @property
    def is_closed(self) -> bool:
        """Whether the world is gone."""
        return self._handle is None

    def close(self) -> None:
        """Free the world. Closing again does nothing."""
        if self._handle is not None:
            capi.disconnect(self._handle)
            self._handle = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __reduce__(self) -> "tuple[object, ...]":
        raise TypeError("a PhysicsClient owns native memory and cannot be pickled")

    def _open(self) -> int:
        if self._handle is None:
            raise client_closed()
        return self._handle

    def _submit(self, command: int, expected: int, action: str) -> int:
        status = capi.submit(self._open(), command)
        self._check(status, expected, action)
        return status

    def _check(self, status: int | None, expected: int, action: str) -> None:
        """Raise unless Bullet answered with the expected status code."""
        code = capi.status_type(status) if status else None
        if code != expected:
            raise refusal(action, code, expected)


def refusal(action: str, code: int | None, expected: int) -> BulletError:
    """The error where Bullet did not answer with the expected status code."""
    answer = "gave no answer" if code is None else f"answered with status {code}"
    return BulletError(f"Bullet could not {action}: it {answer}, expected {expected}")


def client_closed() -> BulletError:
    """The error where a client is closed."""
    return BulletError("the physics client is closed")


def doubles(values: Sequence[float]) -> Array[c_double]:
    """A new C array of doubles."""
    return (c_double * len(values))(*values)


def shared(row: npt.NDArray[np.float64]) -> Array[c_double]:
    """A C array over the memory of a numpy array, (k,) and contiguous."""
    return (c_double * len(row)).from_buffer(row.data)
